"""Code shared by all packages: geometry, compilation, parameters, messages, bags and nodes."""
