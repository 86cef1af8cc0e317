"""Scenarios of simulated swarms without ROS: eight, wandering e-pucks, table of Droplets."""
