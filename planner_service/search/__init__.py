"""Belief about an unseen target, and assignment of places to search.

`target_search` begins and ends a search and publishes the belief; `searcher` gives each vehicle a place, drawn by
belief over cost; `belief` is a grid of probabilities that is moved by the target's possible motion and cut by the
views of vehicles; `search_routes` finds the paths from vehicles to their places.
"""
