"""The runtime of a process: its loop, its membership in a run, and what it tells of itself.

One thread owns the state of a service (`process`); all others post to its `inbox`, which is bounded, fair by topic
and answers in time under overload. Mechanisms of every role:

`membership`     Shows that the process is alive, compares runs, publishes counters (`stats`) and alarms.
`election`       Decides which of several processes with one job leads: by rank, heartbeats and a lease.
`order_book`     Holds what operators have ordered. `OrderClient` is the side of those who obey, `operator` that of
                 those who order.
`tracker_ownership`  Decides which of several trackers owns a target.
`loop_health`    Tells whether the loop turns, to other threads and processes and to systemd.
`role_setup`     The setup that a process is started with. `run_secret` is what processes of one user share.
"""
