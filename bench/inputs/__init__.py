"""`make bench-inputs`."""
