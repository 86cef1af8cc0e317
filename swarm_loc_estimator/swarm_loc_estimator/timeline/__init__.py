"""The estimator over time: delayed and out-of-sequence measurements, estimates."""
