"""Sessions and drivers of e-pucks."""
