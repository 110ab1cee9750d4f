"""`./launch_scripts/bench wire` runs small, and what must hold holds: nothing is lost, everything has its ratio."""

import pytest
from bench.wire import codec, partition
from support.benchmarks import bench

from swarm.errors import SwarmError

pytestmark = pytest.mark.network


def test_the_wire_is_measured_beside_raw_zenoh_and_nothing_is_left_running() -> None:
    small = ["--marks", "20", "--sets", "500", "--rounds", "1", "--joins", "1", "--seconds", "1"]
    report = bench("wire", "--parts", "latency,throughput,join", *small)
    assert report["latency"]["lost"] == 0
    assert report["throughput"]["superseded_or_lost"] == 0
    assert report["join"]["sets"] == 4000
    assert [row["what"].partition(", p")[0] for row in report["rows"]] == [
        "mark put -> applied elsewhere",
        "mark put -> applied elsewhere",
        "sets applied",
        "late join of 4,000 sets",
    ]
    assert all(row["ratio"] > 0 and row["wanted"] > 0 for row in report["rows"])


def test_the_codec_is_measured_beside_msgspec_alone_and_hostile_payloads_take_bounded_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(codec, "_SECONDS", 2)
    report = codec.measure()
    assert {row["message"] for row in report["types"]} >= {"MarkSet", "TargetPose", "RouteReply", "Stats"}
    assert sum(row["share"] for row in report["types"]) == pytest.approx(1, abs=0.01)
    assert report["ratio_encode_us"] > 0
    assert report["ratio_decode_us"] > 0
    assert max(row["ours_mib"] for row in report["hostile"]) < 100


def test_a_machine_that_cannot_play_two_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partition, "why_not", lambda: "there is no command ip (iproute2)")
    with pytest.raises(SwarmError, match=r"this machine cannot run two network namespaces: there is no command ip"):
        bench("partition", "--rounds", "1")
