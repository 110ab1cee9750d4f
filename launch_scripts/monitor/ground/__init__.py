"""What lies still in the view: the terrain as a mesh of tiles, what colours it in each layer, zones, legends.

`ground_view` decides what is drawn again and when. `terrain_mesh`, `ground_colours`, `cost_to_go` and `zone_areas`
make arrays of what the shared map and planners say; they know no rerun.
"""
