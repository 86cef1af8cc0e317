"""What the marker detector achieves, beside cv2.aruco and pupil-apriltags; run by `bench.epuck`, too."""
