"""Files of a run for people and for other programs.

Commands and the ends of runs and studies write it; nothing else imports it. Matplotlib is imported here alone.

| module               | makes                                                                                   |
|----------------------|-----------------------------------------------------------------------------------------|
| report_and_tracks.py | report.json, tables as CSV, tracks.npz, ground.npz, which it reads again, checked; then |
|                      | all files below, down to report.html                                                    |
| run_page_and_map.py  | report.html, one file: figures, map, plots, tables (templates/); report.png; the map of |
|                      | both: ground, tracks, marks, captures                                                   |
| plots_and_figures.py | plots of a run over time and as distributions, its main figures; figures of a terrain,  |
|                      | of a route on it                                                                        |
| compare.py           | what differs between runs                                                               |
| gis_formats.py       | geometries, rasters and missions in the formats below                                   |
| run_gis_layers.py    | tracks, captures, routes and marks of a run as such geometries; `swarm runs export`     |
| mcap_export.py       | a run as MCAP with ROS 2 messages, in order of time                                     |
"""

FORMATS = {".geojson": "GeoJSON", ".gpkg": "GPKG", ".kml": "LIBKML", ".gpx": "GPX", ".csv": ""}
"""Formats of layers by ending, with GDAL's driver; none: by Python's csv. Here, as each command says in its help
which of them it writes, and must not import NumPy for that."""
SEVERAL = (".gpkg", ".kml")
"""Endings of the formats of which a file holds several layers."""
ON_EARTH = (".kml", ".gpx")
"""Endings of the formats whose places are always longitudes and latitudes."""
AREAS = tuple(ending for ending in FORMATS if ending != ".gpx")
"""Endings of the formats which have areas."""
MISSIONS = (".plan", ".waypoints")
"""Endings of the missions of ground stations."""
