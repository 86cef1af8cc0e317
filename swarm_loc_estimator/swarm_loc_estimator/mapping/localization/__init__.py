"""Where a new scan was made: alignment, loop closure, relocalization."""
