"""Other people's filters on the same data: a simulated run in, poses and CPU seconds out."""
