"""Square markers in images: families, detection, sub-pixel corners and poses."""
