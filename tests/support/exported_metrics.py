"""The export of a swarm in which every figure has a value."""

from prometheus_client.openmetrics.exposition import generate_latest
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from support.makers import planner_status, stats

from launch_scripts.observe.summed_counts import Counts
from launch_scripts.web.prometheus import HELP, Run, families
from shared_map.keeper.service import THROTTLED
from swarm.runtime.stats import CAPTURES_OF, GAPS_TO, READY, Counters
from swarm.wire.messages.vehicles import VehicleState

_MEASURED = ("_ms", "_us", "_excess")
_NOW = (READY, "ended", "cpu_s", "rss_bytes")


def exported() -> dict[str, set[str]]:
    """Name of each sample -> its labels, of a swarm that has everything to tell; read by the strict parser."""
    counters = Counters()
    for name in HELP:
        if name.endswith(_MEASURED):
            counters.observe(name, 1.0)
        elif name in _NOW:
            counters.gauge(name, 1.0)
        else:
            counters.count(name)
    for state in VehicleState:
        counters.gauge(f"vehicles_{state.name.lower()}", 1.0)
    counters.gauge(f"{THROTTLED}all.a0.1", 1.0)
    counters.count_by(CAPTURES_OF, "t0")
    counters.observe_by(GAPS_TO, "t0", 0.03)
    counts = Counts()
    counts.count(stats(counters=counters))
    status = planner_status(pose_age_s=0.5, tracker_lost=True)
    text = generate_latest(families(Run("r", "demo", 1), counts, {"t0": status}, [("agent", "a0")])).decode()
    found: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found
