"""Swarm descriptions and infrared boards as YAML files."""
