"""Identification of anonymous robots from above: which of the detections in an aerial image is a robot."""
