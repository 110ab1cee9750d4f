"""The ground before any mark: elevation, photo and classes become pace, by rules that give the same bits
everywhere.

`terrain` builds it, by the merge rule of `pace_layers`: slope (`slope_and_climb`) and classes, then layers of cost
by plug-ins (`cost_layers`), then `zones`. `slope_and_climb` has what a step costs for its rise and for the wind,
`true_ground` what the map does not know. `store` prepares a terrain in a folder, for all processes of a machine,
and keeps it from run to run. `synthetic` makes ground up; files are read by `shared_map.importers`.
"""
