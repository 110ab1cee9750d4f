"""Land cover: classes from a photo, and from land-cover maps.

A photo is read by `photos` and classified by `classify`, by rules that need no labels or learnt from a few. A map
of land cover is read by `land_cover`, which finds out what its codes mean, by the tables of `land_cover.toml` or a
file of the user's own.
"""
