"""Files that drivers read."""
