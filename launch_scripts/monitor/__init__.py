"""The live view: subscribes, keeps a replica of the map, and tells rerun."""
