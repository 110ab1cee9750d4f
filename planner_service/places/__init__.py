"""Routes to any place: one process for all vehicles that are sent somewhere.

The service answers from trees that are kept by goal and class (`goal_trees`). Growths run beside the loop, a slice
at a time, and each question has its turn. A question that still grows after half a second gets an answer that says
so, and the asker comes again. A cache is no state, so a new life begins with an empty one.
"""
