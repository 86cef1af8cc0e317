"""Scenarios of simulated swarms: eight, wandering e-pucks, table of Droplets."""
