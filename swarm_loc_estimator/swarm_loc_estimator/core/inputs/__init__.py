"""From messages to measurements: validation, cameras, infrared."""
