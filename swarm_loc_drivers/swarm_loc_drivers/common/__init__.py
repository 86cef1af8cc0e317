"""What all drivers share: links, odometry, diagnostics, nodes."""
