"""The pose graph: stops as nodes, constraints, Gauss-Newton."""
