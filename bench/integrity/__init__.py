"""`make bench-integrity`."""
