"""A seed replays a run: the same events, byte for byte, and the same report."""

import io
import os
import subprocess
import sys

import pytest
from support.simulated import simulate

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.sample_worlds import SMALL, seeded

RUN = """
import json, sys
from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.sample_worlds import SMALL
from support.simulated import simulate
with open(sys.argv[1], "w") as trace:
    seed = int(sys.argv[2])
    result = simulate(SMALL, seed, 12, random_plan(SMALL, seed, 12), trace)
print(json.dumps(result))
"""


@pytest.mark.parametrize("seed", [4])
def test_a_run_is_the_same_byte_for_byte_whatever_the_hash_seed_is(seed, tmp_path):
    runs = []
    for hash_seed in ("1", "4242"):
        trace = tmp_path / f"{hash_seed}.log"
        runs.append(
            subprocess.Popen(
                [sys.executable, "-c", RUN, str(trace), str(seed)],
                env={**os.environ, "PYTHONHASHSEED": hash_seed},
                stdout=subprocess.PIPE,
            )
        )
    reports = [run.communicate(timeout=250)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    one, other = ((tmp_path / f"{hash_seed}.log").read_bytes() for hash_seed in ("1", "4242"))
    assert one.count(b"\n") > 3000
    assert b" crash " in one
    assert one == other
    assert reports[0] == reports[1]


def test_watching_a_run_does_not_change_it():
    trace = io.StringIO()
    plan = random_plan(SMALL, 3, 4)
    one = simulate(seeded(3), seconds=4, faults=plan, trace=trace)
    other = simulate(seeded(3), seconds=4, faults=plan)
    assert one == other
    assert trace.getvalue().splitlines()[0].startswith("0.")
    assert one["deliveries"] == sum(" > " in line for line in trace.getvalue().splitlines())
