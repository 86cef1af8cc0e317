"""The page on which people watch a swarm: what it is told, how it is served, and its files."""
