"""A gateway to ROS 2 without ROS: what rmw_zenoh puts on the wire, put there by Zenoh and two small packages.

The wire format is rmw_zenoh's (its design.md): keys, liveliness tokens and attachments in `rmw`, types and CDR in
`ros_types`, a node on a Zenoh session in `ros_node`. `topic_table` says what crosses; nothing else does. What goes
out has its core in `gateway`: what an observer of the swarm sees, and the time, become messages (`ros_messages`,
`map_messages`; `map_feed` is the map). `incoming/` has what comes in. `service` is the process.

The room promises: topics keep their rates whatever the clock does. A ROS side which hangs or floods costs the swarm
nothing. What comes from ROS is checked before the swarm hears of it.
"""
