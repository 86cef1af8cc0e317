"""`make bench-commissioning`."""
