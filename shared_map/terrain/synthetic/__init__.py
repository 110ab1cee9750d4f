"""Made-up ground: seeded landscapes, rivers and roads."""
