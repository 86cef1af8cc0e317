"""Images, cameras, sampling and what all camera nodes share."""
