"""Graphs of nodes as data, as processes and as launch actions."""
