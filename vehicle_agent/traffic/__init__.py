"""Right of way between vehicles of all agents: reservations, territory, deadlocks, resumption."""
