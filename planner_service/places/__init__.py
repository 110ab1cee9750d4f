"""Routes between any two places, for all vehicles that are sent somewhere and for all others that ask.

The service answers from trees that are kept by goal and class (`goal_trees`). A worker grows them beside the loop,
a slice of cells at a time, and askers take turns. A cache is no state, so a new life begins with an empty one.
"""
