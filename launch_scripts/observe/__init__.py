"""A running swarm as seen from outside: heard in one way, kept in one state, shown in one table of facts.

    bus -> RunObserver -> LatestState -> RunState -> text of a fact
                       -> Recorder    -> report

| module             | holds                                                                                    |
|--------------------|------------------------------------------------------------------------------------------|
| run_observer.py    | `RunObserver` hears the bus for those who know the run; `OutsideObserver` for commands   |
| latest_messages.py | `LatestState`: newest message of every sender; `RunPlan`: what the run should be         |
| summed_counts.py   | `Counts`: sums of all processes, with the certified gap, and the load of each            |
| run_state.py       | `RunState`: the run at an instant; `state_of` makes one; `FACTS`, `TARGET_FACTS`: name,  |
|                    | label, unit and text of each fact                                                        |
| alarms.py          | `Alarm`, `KINDS`: what went wrong, where, since when, and whether it is over             |
| recorder.py        | `Recorder`: figures, tracks, routes, captures, notes over time, in bounded memory; it    |
|                    | makes the numbers of the report, and results per target, group and vehicle               |
| run_folders.py     | the folder of a run; the runs of this user on this machine, each by a small file         |
| palette.py         | how pictures and the live view look                                                      |

A new fact is a field of `RunState` with a `Fact`, which every report has; `LINES` and `IF_ANY` place it in the
lines for people. Facts are counted by the process that does the counted work, and a restarted process continues
its previous counts (`swarm.runtime.stats.carried`). All watchers therefore agree once messages have arrived,
whenever they began to watch.
"""
