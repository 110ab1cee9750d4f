"""The network of a process: one protocol (`bus`), on Zenoh for real processes and in memory for simulations.

The rules that both keep, about threads, order, losses, deadlines and rejections, stand at the top of `bus`.
`tests/support/bus_behaviour.py` holds both to them. Every payload is checked and counted before a service sees it
(`zenoh_intake`). A router admits by certificate the messages which the table of topics grants (`zenoh_config`).
"""
