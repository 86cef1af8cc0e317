"""The player of bags as a node."""
