"""What a robot saw from one place: its beams, and the lines that they tell."""
