"""The sparse filter: a junction tree of fronts from a nested dissection of who sees whom."""
