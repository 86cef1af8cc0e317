"""Drivers and simulated hardware of the robots of a swarm."""
