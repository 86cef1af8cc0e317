"""Scenarios of simulated swarms: eight, grid, dense crowd, table of Droplets."""
