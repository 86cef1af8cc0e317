"""Runs of the live graph, recorded and compared with replay."""
