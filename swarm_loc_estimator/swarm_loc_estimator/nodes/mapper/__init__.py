"""The mapper as a node."""
