"""The central estimator of a robot swarm: one buffered EKF over all robots, its replay, its player and its reports."""
