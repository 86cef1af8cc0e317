"""The joint EKF: state, prediction, measurement model, gating, updates."""
