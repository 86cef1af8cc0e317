"""`make bench-droplet_real`."""
