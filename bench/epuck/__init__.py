"""`make bench-epuck`."""
