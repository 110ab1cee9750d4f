"""Where a target may be that nobody sees, and who looks where.

`target_search` begins and ends a search and says what is believed; `searcher` gives each vehicle a place, drawn by
belief over cost; `belief` is a grid of probabilities that is moved by what the target may have done and cut by what
vehicles have looked at; `search_routes` finds the ways from vehicles to their places.
"""
