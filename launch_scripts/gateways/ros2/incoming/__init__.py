"""Incoming side from ROS: robots, goals, targets, areas and services.

`Incoming` is the shell: it finds robots and calls all parts at ticks. Each topic is an `Input` (`ros_node`): the
newest message alone is kept until a tick, so that a flood costs no more than one message, and why it is refused is
said once.
`ros_places` makes checked places and areas of messages; what it refuses is a ConfigError with a sentence. Requests
that may wait (an order until it is obeyed, a route until its planner replies) are done by a `WorkQueue`, which is
bounded.
"""
