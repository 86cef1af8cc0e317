"""Sheets of markers to print in true size."""
