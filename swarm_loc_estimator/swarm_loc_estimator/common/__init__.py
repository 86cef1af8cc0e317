"""What all packages share: geometry, compilation, parameters, messages, bags and nodes."""
