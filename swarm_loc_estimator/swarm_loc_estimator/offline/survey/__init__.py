"""Places of landmarks from a recording of robots that drive around, by batch least squares."""
