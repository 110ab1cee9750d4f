"""Rasters: opened, understood, and put on one square metric grid."""
