"""Web page with a live view of the swarm: server, frames, node; markers for RViz and Foxglove."""
