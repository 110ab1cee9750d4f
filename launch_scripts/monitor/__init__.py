"""The live view: records a run, and shows it to connected viewers.

- `main`: the process; `service` hears the swarm and draws it frame by frame, ten a second for those who look, else
  five (docs/design/live-view.md). It queries nothing but costs of planners, and no process waits for it.
- `ground_view` lies still: the terrain, its layers with their legends, zones. It decides what is drawn again and
  when. `terrain_mesh` and `ground_colours` make arrays of what the shared map and planners say; they know no rerun.
- `movers_view` moves: vehicles with their trails and routes, targets, obstacles, beliefs, alarms.
  `styles` is the one table of colours and of how much is drawn for how many vehicles.
- `live_layout` has the layers, their legends, and the panels beside: plots, a summary, a log.
- `rerun_outputs` has the pen, which logs differences only, and its destinations: a file `run.rrd`, and a page
  whose port has the stream for native viewers, too. If the file ends for want of space, another is begun
  once there is some.
"""
