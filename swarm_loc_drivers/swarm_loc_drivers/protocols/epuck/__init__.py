"""The bytes of e-pucks."""
