"""The processes of a run on this machine: start, watch, restart, stop, show. Work of `swarm demo` and `swarm up`.

Guarantees of a launcher:

- All processes are forked by one server, which loads what they share once (`forkserver`, `preloaded`). It starts
  before the command itself is loaded, and kernels that no process has compiled yet are compiled beside it.
- A process that crashes is started again after a wait that doubles, one whose loop stands still is killed and
  started again, and one that refuses to run ends the run with its sentence (`local_processes`). Each start has a
  higher incarnation than all before (`run_options.next_incarnation`), whatever the clock says.
- Roles end in the order of the table of processes, each after those which still talk to it. A second Ctrl-C ends
  all of them within a second (`signals`). No process outlives its launcher, even where that is killed.
- A launcher listens only (`watcher`): it is no member of the run, and its absence changes nothing. The one that
  starts the first keeper records and reports the run, all others look after their own processes.
- Targets which operators add or remove while the swarm runs start and end planners (`ordered_planners`).
- An upgrade takes a running part over (`takeover`): successors get ready beside it before it is asked to end.

`up` is the order of all that, from the terrain (`fetched_terrain`) to the report; `console`
show it."""
