"""The panels in which help shows commands and options."""

from __future__ import annotations

RUN = "Run a swarm"
PREPARE = "Before a run"
ASK = "Ask a running swarm"
ORDER = "Give a running swarm orders"
LEFT = "What runs have left"
ROLE = "One role, by hand"
ADMIN = "Several machines, and figures"

NETWORK = "Where the swarm is"
CERTIFICATES = "Certificates (all three, or none)"
PART = "A part of a swarm"
