"""Routes to any place: one process for all vehicles that are sent somewhere.

The service answers from trees that are kept by goal and class (`goal_trees`). A growth goes on for some cells with
each question, and the answer says so while it is not done: the asker comes again, and the loop never waits. A cache
is no state, so a new life begins with an empty one.
"""
