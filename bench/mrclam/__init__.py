"""`make bench-mrclam`."""
