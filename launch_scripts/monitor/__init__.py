"""The live view: records a run, and shows it to connected viewers.

- `main`: the process; `service` hears the swarm and draws it frame by frame, ten a second for those who look, else
  five (docs/design/live-view.md). It queries nothing but costs of planners, and no process waits for it.
- `ground` lies still: the terrain, its layers with their legends, zones.
- `movers` moves: vehicles, targets, obstacles, their routes and trails, beliefs, alarms.
- `live_layout` has the layers, their legends, and the panels beside: plots, a summary, a log.
- `view_outputs` has the pen, which logs differences only, and its destinations: a file `run.rrd`, a port for native
  viewers, a page. If the file ends for want of space, another is begun once there is some.
"""
