"""Terrain and marks become cost: what all processes share."""
