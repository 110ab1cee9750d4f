"""The live view: records a run, and shows it to whoever looks.

- `main`: the process; `service` hears the swarm and draws it frame by frame, ten a second for those who look, else
  five (decision 102). It asks nothing but costs of planners, and nobody waits for it.
- `ground` lies still: the terrain, its layers with their legends, zones.
- `movers` moves: vehicles, targets, bodies, their routes and trails, beliefs, alarms.
- `live_layout` has the layers, their legends, and what stands beside: plots, a summary, a log.
- `view_outputs` has the pen which logs what differs from what was logged last, and where that goes: a file
`run.rrd`, a
  port for native viewers, a page. If the file ends for want of space, another is begun once there is some.
"""
