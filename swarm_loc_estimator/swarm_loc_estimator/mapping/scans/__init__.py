"""What a robot saw from one place: its beams, and their lines."""
