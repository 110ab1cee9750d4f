"""A gateway to ROS 2 without ROS: what rmw_zenoh puts on the wire, put there by Zenoh and two small packages.

The wire format is rmw_zenoh's (its design.md): keys, liveliness tokens and attachments in `rmw`, types and CDR in
`ros_types`, a node on a Zenoh session in `ros_node`. `gateway_settings` says what crosses; nothing else does. The
core of outgoing topics is `outgoing`: it turns an observer's view of the swarm, and the time, into messages
(`ros_messages`, `map_messages`). `incoming` has the incoming side. `service` is the process.

The room promises: topics keep their rates whatever the clock does. A ROS side which hangs or floods costs the swarm
nothing. Messages from ROS are checked before they enter the swarm.
"""
