"""Metrics are valid OpenMetrics whatever comes from the network, and give the figures of the processes."""

import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from urllib.request import Request, urlopen

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from prometheus_client.parser import text_string_to_metric_families as plain_families
from support.exported_metrics import exported
from support.makers import planner_status, stats

from launch_scripts import web
from launch_scripts.observe.summed_counts import Counts
from launch_scripts.web.prometheus import HELP, Families, MetricsEndpoint, Run, families, named
from swarm.clock import NS_PER_S
from swarm.runtime.stats import CAPTURES_OF, GAPS_TO, Counters
from swarm.wire.messages.processes import Stats

_BEGAN_NS = 1_790_000_000 * NS_PER_S


def _stats(role: str, id: str, counters: Counters, generation: int = _BEGAN_NS) -> Stats:
    return stats(role, id, counters, incarnation=generation, stamp_ns=generation + NS_PER_S)


@pytest.fixture
def figures() -> Families:
    counts, agent, targets = Counts(), Counters(), Counters()
    agent.count("messages_out", 40)
    agent.count("ticks_late", 3)
    agent.gauge("vehicles_following", 6)
    for ms in (1.0, 3.0, 40.0, 20_000.0):
        agent.observe("route_query_ms", ms)
    agent.observe_by(GAPS_TO, "t0", 0.03)
    targets.count("captures", 2)
    targets.count_by(CAPTURES_OF, "t0")
    counts.count(_stats("agent", "a0", agent))
    counts.count(_stats("targets", "0", targets))
    status = planner_status(
        "t0", stamp_ns=_BEGAN_NS, tree_age_ms=250.0, growths=2, window_growths=3, growth_ms=4.0, routes_served=5,
        following=7, pose_age_s=0.5, tracker_lost=True,
    )  # fmt: skip
    return families(Run("r1", "demo", _BEGAN_NS), counts, {"t0": status}, [("agent", "a0")])


def _scraped(endpoint: MetricsEndpoint, figures: Families, **headers: str) -> str:
    """The text of a scrape, answered by this thread as its owner would."""
    with ThreadPoolExecutor(1) as visitor:
        reply = visitor.submit(urlopen, Request(endpoint.url, headers=headers), timeout=10)
        while not reply.done():
            endpoint.answer(lambda: figures)
            wait([reply], 0.01)
    with reply.result() as told:
        return str(told.read().decode())


@pytest.fixture
def endpoint() -> Iterator[MetricsEndpoint]:
    made = MetricsEndpoint(0, list)
    yield made
    made.close()


def _samples(text: str) -> dict[tuple[str, ...], float]:
    return {
        (sample.name, *(f"{label}={value}" for label, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_a_scrape_says_what_processes_said(endpoint: MetricsEndpoint, figures: Families) -> None:
    found = _samples(_scraped(endpoint, figures, accept="application/openmetrics-text; version=1.0.0"))
    assert found["swarm_run_info", "run_id=r1", "scenario=demo"] == 1
    assert found["swarm_process_up", "id=a0", "role=agent"] == 1
    assert found["swarm_process_up", "id=0", "role=targets"] == 0, "its token is not up"
    assert found["swarm_messages_sent_total", "id=a0", "role=agent"] == 40
    assert found["swarm_vehicles", "id=a0", "role=agent", "state=following"] == 6
    assert found["swarm_target_captures_total", "target=t0"] == 1
    assert found["swarm_target_lost", "target=t0"] == 1
    assert found["swarm_target_tree_age_seconds", "target=t0"] == 0.25
    query = "swarm_route_query_seconds"
    assert found[f"{query}_count", "id=a0", "role=agent"] == 4
    assert found[f"{query}_sum", "id=a0", "role=agent"] == pytest.approx(20.044, rel=0.02)
    under = {key[2]: value for key, value in found.items() if key[0] == f"{query}_bucket"}
    assert under["le=0.0005"] == 0
    assert under["le=0.005"] == 2
    assert under["le=10.0"] == 3, "20 s are above all bounds"
    assert under["le=+Inf"] == 4


def test_prometheus_of_any_age_reads_it(endpoint: MetricsEndpoint, figures: Families) -> None:
    assert {family.name for family in plain_families(_scraped(endpoint, figures))} >= {
        "swarm_captures",
        "swarm_route_query_seconds",
    }


_names = st.one_of(
    st.text(max_size=12), st.sampled_from(["run", "process_up", "x_total", "x_count", "x", "Ä", "vehicles_"])
)


@given(
    counts=st.dictionaries(_names, st.integers(0, 9), max_size=5),
    gauges=st.dictionaries(_names, st.floats(allow_nan=False, allow_infinity=False), max_size=5),
    histograms=st.dictionaries(
        _names, st.dictionaries(st.integers(-300, 300), st.integers(1, 9), max_size=4), max_size=4
    ),
)
def test_no_name_from_the_network_breaks_a_scrape(
    counts: dict[str, int], gauges: dict[str, float], histograms: dict[str, dict[int, int]]
) -> None:
    from prometheus_client.openmetrics.exposition import generate_latest

    heard = Counts()
    heard.count(stats(counts=counts, gauges=gauges, histograms=histograms))
    run = Run('a"\n\\b', "demo", _BEGAN_NS)
    text = generate_latest(families(run, heard, {}, [("agent", "a0")])).decode()
    found = _samples(text)
    assert found["swarm_process_up", "id=a0", "role=agent"] == 1
    assert found["swarm_run_info", 'run_id=a"\n\\b', "scenario=demo"] == 1


def test_units_are_those_of_prometheus() -> None:
    assert named("route_query_ms")[:2] == ("route_query_seconds", 1e-3)
    assert named("followed_gap_excess")[0] == "followed_gap_excess_ratio"
    assert named("bytes_out")[0] == "sent_bytes"
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", named(name)[0]) for name in HELP)


def test_the_dashboard_asks_for_what_is_exported() -> None:
    board = json.loads(Path(web.__file__).with_name("dashboard.json").read_text(encoding="utf-8"))
    asked = {
        name
        for panel in board["panels"]
        for target in panel["targets"]
        for name in re.findall(r"swarm_[a-z0-9_]+", target["expr"])
    }
    assert len(asked) >= 10
    assert asked <= exported().keys()
