"""Identification of anonymous robots from above."""
