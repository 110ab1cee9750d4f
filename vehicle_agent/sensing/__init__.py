"""Views of vehicles: the ground around them, which is compared with the map, and targets within range.

Sensors are simulated from the true ground and the true poses; a plug-in may take the place of the sensor of ground.
"""
