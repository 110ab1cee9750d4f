"""Zones from vector files and from rasters of pace."""
