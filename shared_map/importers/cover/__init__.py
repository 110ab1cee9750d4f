"""Land cover: classes from a photo, and from land-cover maps.

A photo is read by `photos` and classified by `classify`, by rules that need no labels (`photo_rules`) or learnt
from a few. A map of land cover is read by `land_cover`; `cover_codes` has what its codes mean, from
`land_cover.toml` or from a table of the user's own, and `cover_meaning` finds out which of these tables a file goes
by.
"""
