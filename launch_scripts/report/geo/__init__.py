"""Tracks, captures and marks of a run for a GIS."""
