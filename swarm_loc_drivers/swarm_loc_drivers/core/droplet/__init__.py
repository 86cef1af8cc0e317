"""Sessions and drivers of Droplets."""
