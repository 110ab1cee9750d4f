"""The picture of a run, and what pictures share."""
