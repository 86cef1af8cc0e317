"""Images, cameras and what all camera nodes share."""
