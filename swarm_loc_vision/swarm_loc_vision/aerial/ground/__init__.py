"""The floor under an overhead camera: control points, floor markers, pixels to places and back."""
