"""Reading and writing bags."""
