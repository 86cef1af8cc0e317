"""The page for watching a swarm: server, files, node, and markers for RViz and Foxglove."""
