"""Importers of public datasets: each is read, and written as a bag with its swarm description."""
