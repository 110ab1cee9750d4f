"""Belief about an unseen target, and assignment of places to search.

`search_triggers` begins and ends a search and publishes the belief; `search_places` gives each vehicle a place,
drawn by belief over cost, and finds the path there; `belief` is a grid of probabilities that is moved by the
target's possible motion and cut by the views of vehicles.
"""
