"""Maps: their files, and the inputs that they are made of."""
