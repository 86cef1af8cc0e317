"""The marker detector, compared with cv2.aruco and pupil-apriltags."""
