"""The topics of the estimator, and the way from raw messages to its columns."""
