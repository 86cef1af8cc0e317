"""The page on which people watch a swarm: how fast, at what cost, and how it looks."""
