"""What a swarm is: robots, sensors, landmarks, and the settings of the estimator."""
