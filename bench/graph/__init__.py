"""Benchmarks of the whole live graph."""
