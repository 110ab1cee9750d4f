"""Right of way for who drives: which cells may be entered, and how to ask for them (decisions 25 and 40)."""
