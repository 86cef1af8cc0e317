"""What benchmarks share: figures, tables and plots, and simulated runs through the core."""
