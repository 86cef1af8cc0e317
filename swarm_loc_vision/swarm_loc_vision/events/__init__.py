"""Blinking lights in the events of an event camera."""
