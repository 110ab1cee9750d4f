"""A gateway to ROS 2 without ROS: what rmw_zenoh puts on the wire, put there by Zenoh and two small packages.

The wire format is rmw_zenoh's (its design.md): keys, liveliness tokens, attachments, CDR.
"""
