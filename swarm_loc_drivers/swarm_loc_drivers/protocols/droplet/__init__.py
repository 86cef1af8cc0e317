"""The bytes of Droplets."""
