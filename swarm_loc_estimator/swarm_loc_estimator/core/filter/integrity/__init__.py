"""Integrity: what contradicts the belief, what noise the description hides, and when a robot is given up."""
