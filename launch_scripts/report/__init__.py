"""Files of a run for people and for other programs.

Commands and the ends of runs and studies write it; nothing else imports it. Matplotlib is imported here alone.

| module             | makes                                                                                   |
|--------------------|-----------------------------------------------------------------------------------------|
| report_json.py     | report.json and tables as CSV; then all files below, down to report.html                |
| npz_files.py       | tracks.npz and ground.npz, and reads them again, checked                                |
| run_picture.py     | report.png: main figures, map, plots; the map of a run: ground, tracks, marks, captures |
| run_page.py        | report.html, one file: figures, map, plots, tables (templates/)                         |
| plots_and_cards.py | plots of a run over time and as distributions, its main figures; a study's outcomes     |
| terrain_figure.py  | figures of a terrain, of a route on it, of slope rules                                  |
| compare.py         | what differs between runs                                                               |
| gis_formats.py     | geometries and rasters as GeoJSON, GeoPackage, KML, GPX, CSV, GeoTIFF; missions         |
| run_gis_layers.py  | tracks, captures, routes and marks of a run as such geometries; `swarm runs export`     |
| mcap_export.py     | a run as MCAP with ROS 2 messages, in order of time                                     |
"""
