"""A seed replays a run, byte for byte: what it does depends on its world and number alone. `swarm simulate --seeds`
tries many, and each law can break."""

import io
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from support.simulated import simulate

from launch_scripts.commands.simulation_commands import simulate_seeds
from launch_scripts.simulation.faults import FaultPlan, random_plan
from launch_scripts.simulation.laws import LONGEST_WAIT_S, BrokenLaw, LawBook
from launch_scripts.simulation.sample_worlds import MIXED, SMALL, seeded
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.trials import MIX, SECONDS, Result, replay_of, world_of
from vehicle_agent.traffic.next_cells import Steering

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


def test_neither_watching_nor_recording_a_run_changes_it(tmp_path):
    plan, watched, recorded = random_plan(SMALL, 3, 4), io.StringIO(), io.StringIO()
    one = simulate(seeded(3), seconds=4, faults=plan, trace=watched)
    simulate(seeded(3), seconds=4, faults=plan, trace=recorded, record_to=tmp_path)
    assert one == simulate(seeded(3), seconds=4, faults=plan)
    lines = watched.getvalue().splitlines()
    assert lines == recorded.getvalue().splitlines()
    assert lines[0].startswith("0.")
    assert one["deliveries"] == sum(" > " in line for line in lines)


def test_the_mix_takes_every_world_in_turn_and_a_replay_names_it():
    assert [world_of(MIX, seed) for seed in range(6)] == list(MIXED)
    assert replay_of("doors", 9, 30.0, SECONDS) == "swarm simulate doors --seeds 9:10"
    assert replay_of("doors", 9, 5.0, SECONDS).endswith("--seconds 5")


def test_a_process_that_never_comes_back_breaks_a_law():
    simulation = Simulation(seeded(1), faults=FaultPlan(quiet_s=4))
    trial = LawBook(simulation)
    simulation.run_until(3)
    simulation.nodes["agent-a1"].crash()
    assert "a process did not start again" in map(str, trial.run(10))


def test_each_law_has_its_sentence():
    simulation = Simulation(seeded(1), faults=FaultPlan(quiet_s=4))
    book = LawBook(simulation)
    simulation.run_until(3)
    book._unmoved |= {f"w{cell}": cell for cell in range(simulation.terrain.grid.cells)}
    book._grounds["ground"].pace_s_per_m = np.full(simulation.terrain.grid.cells, np.inf, np.float32)
    book.acknowledged["nobody.a9.1", 0] = (1, 1)
    book.longest_s, book.longest = 11.0, (12.0, "v", 5)
    broken = {law.law: law for law in book.run(10)}
    said = {
        "no collision": r"collision at 3.\d\d s: a\d-\d\d and w(\d+) on cell \1",
        "no lethal entry": r"lethal entry at 3.\d\d s: a\d-\d\d on cell \d+",
        "acknowledged marks stay": r"1 acknowledged sets are lost, such as \('nobody.a9.1', 0\)",
        "no wait without a reason": "v waits 11.0 s on cell 5 without a reason, until 12.0 s",
    }
    assert broken.keys() == said.keys()
    for law, sentence in said.items():
        assert re.fullmatch(sentence, str(broken[law]))
    assert broken["acknowledged marks stay"].at_s is None
    assert broken["no wait without a reason"].at_s == 12.0


@pytest.mark.parametrize("works", [True, False])
def test_a_wait_counts_as_long_as_every_process_works(works: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Steering, "closed", lambda self, cell: True)
    simulation = Simulation(seeded(1))
    book = LawBook(simulation)
    simulation.run_until(2)
    if not works:
        simulation.nodes["keeper-0"].crash()
    simulation.run_until(14)
    assert (book.longest_s > LONGEST_WAIT_S) == works


def test_the_command_prints_figures_and_the_failing_seeds(capsys, monkeypatch):
    assert simulate_seeds("small", "3:4", 8, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["seeds"] == 1
    assert printed["failing"] == []
    assert printed["results"][0]["figures"]["deliveries"] > 1000
    broken = [BrokenLaw("a law", "it broke")]
    result = Result(key="", figures={"longest_wait_s": 1.0}, broken=broken, wall_s=1.0, cpu_s=1.0)
    monkeypatch.setattr("launch_scripts.simulation.trials.run_trial", lambda trial: result)
    assert not simulate_seeds("small", "3:4", None, as_json=False)
    out = capsys.readouterr().out
    assert "FAILED small seed 3" in out
    assert "it broke" in out
    assert "failed: swarm simulate small --seeds 3:4" in out
    assert "1 of 1 seed broke a law" in out
