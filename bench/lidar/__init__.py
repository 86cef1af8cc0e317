"""Lidars in real buildings."""
