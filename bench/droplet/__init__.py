"""`make bench-droplet`."""
