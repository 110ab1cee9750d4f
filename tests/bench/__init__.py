"""Measurements, started by `./launch_scripts/bench NAME [options]`; without a name it lists them.

`harness` makes commands of functions and shows what they return, `isolated` runs work in a process of its own.
`planning` measures trees, routes and certificates, `wire` what travels between processes, `whole_swarm` swarms.
"""
