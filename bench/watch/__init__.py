"""The page on which people watch a swarm: what its tests share, and its pictures."""
