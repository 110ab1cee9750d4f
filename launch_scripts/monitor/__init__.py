"""The live view: subscribes, keeps a replica of the map, and logs to rerun."""
