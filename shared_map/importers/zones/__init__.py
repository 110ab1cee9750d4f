"""Zones that files draw: vector files, whose features are burnt into cells, and rasters of pace.

`zone_files` is the door, with the table of kinds. `vector_files` opens a file, checks its text, and reads its
features as they are stored. `burn_shapes` repairs them, brings them into cells, and burns them. `zone_features`
decides which features count and what they are worth, by the classes of ways in `ways.toml`. Only these need the
extra `vectors`.
"""
