"""Simulated rooms: robots that drive about by themselves, and sensors as messages."""
