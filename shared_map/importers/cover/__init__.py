"""Land cover: classes from a photo, and from land-cover maps.

A photo is read by `photos` and classified by `classify`, by rules that need no labels (`photo_rules`) or learnt
from a few. A map of land cover is read by `land_cover`, which finds out what its codes mean; `cover_codes` has the
tables, from `land_cover.toml` or from a file of the user's own.
"""
