"""What all nodes share: parameters, start and end."""
