"""The dense filter: one full covariance matrix."""
