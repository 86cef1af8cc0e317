"""From an image to markers: candidates, sides, corners."""
