"""Nodes for people who look: the page in a browser, and markers for RViz and Foxglove."""
