"""What a process may do with the network: the protocol, on Zenoh and in memory."""
