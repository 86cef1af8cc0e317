"""What benchmarks share: figures, tables and plots, bags, and simulated runs through the core."""
