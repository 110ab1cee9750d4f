"""A vehicle that speaks MAVLink as a vehicle of the swarm: one process for each link
(docs/design/mavlink-adapter.md).

Bytes of a link (`link`) become checked messages (`mavlink_codec`). The core (`adapter`) takes them, the swarm's
routes and the time, and returns due actions: calls of the swarm's client, and messages to the vehicle. `guidance`
leads the vehicle along a route, `arming` says when it may be armed. The shell (`service`) performs.

The room promises: no vehicle is armed and no mode is set without `--arm`. Any other controller that takes command
authority keeps it. One mission is in flight at a time. The vehicle hears a heartbeat each second, and nothing else
while its link is lost.
"""
