"""Static part of the view: the terrain as a mesh of tiles, its colours in each layer, zones.

`ground_view` decides what is drawn again and when. `terrain_mesh` and `ground_colours` make arrays of what the
shared map and planners say; they know no rerun.
"""
