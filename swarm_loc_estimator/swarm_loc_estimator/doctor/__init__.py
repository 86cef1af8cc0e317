"""Checks of a swarm's topics, live or in a bag: what is wrong, and what to do about it."""
