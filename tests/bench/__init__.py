"""Measurements, run by hand and recorded with machine, size and command."""
