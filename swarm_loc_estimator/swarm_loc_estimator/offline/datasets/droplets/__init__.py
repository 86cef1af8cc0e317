"""Recordings of Droplets under an overhead camera: matrices of their console, camera poses beside each."""
