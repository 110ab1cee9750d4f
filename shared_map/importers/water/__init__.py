"""Level ground, water and voids, found before any resampling."""
