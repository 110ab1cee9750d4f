"""Right of way for those who decide it: members and wardens of plots, and where vehicles would go next."""
