"""The central estimator of a robot swarm, its replay, its player and its reports."""
