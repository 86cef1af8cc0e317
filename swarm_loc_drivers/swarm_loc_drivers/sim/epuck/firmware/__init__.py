"""Emulated firmware: answers the bytes of a driver with what a simulated robot does."""
