"""A process's recorded inputs, fed to the same code, give the same outputs; other outputs are found at their
event."""

import dataclasses
import itertools
import json
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.simulated import simulate
from typer.testing import CliRunner

from launch_scripts.commands.result_commands import app
from launch_scripts.simulation import simulate as simulating
from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.replay import recordings_of, replay_run
from launch_scripts.simulation.sample_worlds import SMALL
from planner_service.planning_process import shared_costs
from planner_service.service import PlannerService
from shared_map.terrain.terrain import build_terrain
from swarm.errors import ConfigError, StoreError
from swarm.recording import recording_file
from swarm.recording.record_inputs import Recording
from swarm.recording.recording_file import MAGIC, Called, Handled, Output, Outputs, Record, RecordReader, packed
from swarm.recording.replay_service import Outcome
from swarm.runtime.role_setup import RoleSetup
from vehicle_agent.agent import Agent

SECONDS = 6


def record(folder: Path, seed: int, seconds: float = SECONDS) -> Path:
    plan = random_plan(SMALL, seed, seconds)
    simulate(SMALL, seed, seconds, plan, record_to=folder)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("run"), 4)


def records_of(path: Path) -> list[Record]:
    with RecordReader(path) as reader:
        return [reader.head, *reader]


def recorded_of(run: Path, process: str) -> list[Record]:
    """The recording of a process's first incarnation."""
    return records_of(recordings_of(run, process)[0][0].path)


def outcome_of(folder: Path) -> Outcome:
    """The outcome of a run with one recording, which can be replayed."""
    (found,) = replay_run(folder)
    assert found.outcome is not None
    return found.outcome


def rewritten(run: Path, folder: Path, process: str, changed: list[Record]) -> Path:
    """A run with one recording, of other records."""
    path = recordings_of(run, process)[0][0].path
    (folder / "inputs").mkdir(parents=True, exist_ok=True)
    (folder / "inputs" / path.name).write_bytes(MAGIC + packed(*changed))
    return folder


@pytest.mark.parametrize("seed", [4, 11])
def test_every_process_of_a_faulty_run_gives_the_same_when_replayed(seed: int, run: Path, tmp_path: Path) -> None:
    replayed = list(replay_run(run if seed == 4 else record(tmp_path, seed, 3)))
    assert {each.recorded.head.role for each in replayed} == {"keeper", "planner", "targets", "agent"}
    assert seed != 4 or max(each.recorded.generation for each in replayed) > 1  # crashes
    for each in replayed:
        assert each.same, each
        assert each.outcome.events > 5
        assert each.outcome.outputs > 5


def test_what_planners_read_of_clock_and_kernels_is_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = msgspec.structs.replace(
        SMALL, seed=4, planner=msgspec.structs.replace(SMALL.planner, strategy="multi_resolution")
    )
    shared = shared_costs(tmp_path, build_terrain(scenario), scenario.planner)
    calls = itertools.count()
    # The inputs of a live planner: CPU time, kernels that are compiled by and by.
    of_live = {
        "stopwatch": time.thread_time_ns,
        "all kernels": lambda: next(calls) > 40,
        "modules of zones": lambda: True,
    }
    function = Recording.function

    def functions(self: Recording, name: str, given: object, kind: Any) -> Any:
        return function(self, name, of_live[name], kind)

    with monkeypatch.context() as live:
        live.setattr(Recording, "function", functions)
        live.setattr(simulating, "PlannerService", lambda *given: PlannerService(*given, shared))
        simulate(scenario, seconds=3, record_to=tmp_path)
    # These planners compute their own cell costs.
    for process in ("planner-t0", "planner-t1"):
        (replayed,) = replay_run(tmp_path, process)
        assert replayed.same, replayed


def test_an_error_of_a_service_is_its_last_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decide = Agent.decide
    calls = 0

    def fails(agent: Agent, now_ns: int) -> list[Any]:
        nonlocal calls
        calls += 1
        if calls == 30:
            raise ZeroDivisionError("a bug")
        return decide(agent, now_ns)

    one_agent = msgspec.structs.replace(SMALL, vehicles=msgspec.structs.replace(SMALL.vehicles, per_agent=10))
    with monkeypatch.context() as patched:
        patched.setattr(Agent, "decide", fails)
        with pytest.raises(ZeroDivisionError):
            simulate(one_agent, 4, 9, record_to=tmp_path)
        calls = 0
        (replayed,) = replay_run(tmp_path, "agent-a0")
        assert replayed.same
        assert replayed.outcome.ended == "ended by an error"
    (mended,) = replay_run(tmp_path, "agent-a0")
    assert str(mended.outcome.difference and mended.outcome.difference.recorded).startswith("raise ")
    assert mended.outcome.events == replayed.outcome.events - 1


@settings(max_examples=10, deadline=None)
@given(st.data())
def test_an_output_that_was_another_is_found_at_its_event(run: Path, data: st.DataObject) -> None:
    process = data.draw(st.sampled_from(["keeper-0", "planner-t0"]))
    whole = recorded_of(run, process)
    at = data.draw(st.sampled_from([n for n, each in enumerate(whole[:-20]) if isinstance(each, Outputs)]))
    changed = whole[at]
    assert isinstance(changed, Outputs)
    wrong = data.draw(st.integers(0, len(changed.outputs) - 1))
    outputs = list(changed.outputs)
    kind = data.draw(st.sampled_from(["digest", "to", "missing", "more"]))
    if kind == "missing":
        del outputs[wrong]
    elif kind == "more":
        outputs.append(Output("put nowhere", 1, bytes(8)))
    else:
        other = {"digest": bytes(8)} if kind == "digest" else {"to": "put nowhere"}
        outputs[wrong] = msgspec.structs.replace(outputs[wrong], **other)
    event = sum(isinstance(each, Called | Handled) for each in whole[:at])
    folder = rewritten(
        run, run.parent / f"changed-{process}", process, [*whole[:at], Outputs(outputs), *whole[at + 1 :]]
    )
    outcome = outcome_of(folder)
    assert outcome.difference.event == event
    assert outcome.events == max(event - 1, 0)


@settings(deadline=None)
@given(st.data())
def test_a_damaged_recording_is_said_in_a_sentence(run: Path, data: st.DataObject) -> None:
    source = recordings_of(run, "planner-t0")[0][0].path
    content = bytearray(source.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= data.draw(st.integers(1, 255))
    path = run.parent / "damaged.inputs"
    path.write_bytes(content)
    with RecordReader(source) as reader:
        first_block_ends = reader.at
    if at < first_block_ends:
        with pytest.raises(StoreError, match=str(path)):
            RecordReader(path)
        return
    with RecordReader(path) as reader:
        whole = list(reader)
    expected = records_of(source)[1:]
    assert whole == expected[: len(whole)]
    assert len(whole) < len(expected)
    assert reader.damaged is None or str(reader.at) in reader.damaged


def test_a_file_that_is_no_recording_is_said_and_the_others_are_replayed(run: Path, tmp_path: Path) -> None:
    source = recordings_of(run, "keeper-0")[0][0].path
    (tmp_path / "inputs").mkdir()
    (tmp_path / "inputs" / source.name).write_bytes(MAGIC + packed(*records_of(source)[:60]))
    (tmp_path / "inputs" / "agent-a7.5.inputs").touch()  # the disk was full when it began
    told = CliRunner().invoke(app, ["replay", str(tmp_path)])
    assert told.exit_code == 1
    assert "1 of 1 recordings give the same" in told.stdout
    assert "agent-a7.5.inputs is no recording" in told.stdout.replace("\n", "")
    assert CliRunner().invoke(app, ["replay", str(tmp_path), "--process", "keeper-0"]).exit_code == 0


@pytest.mark.parametrize("field", ["role", "id", "versions"])
def test_a_recording_names_no_file_elsewhere_and_steers_no_terminal(field: str, run: Path, tmp_path: Path) -> None:
    head, *whole = recorded_of(run, "keeper-0")
    for wrong in ("x/../../y", "\x1b[31m", "a\n", ""):
        value = {wrong: "\x1b"} if field == "versions" else wrong
        changed = msgspec.structs.replace(head, **{field: value})
        (tmp_path / "x.inputs").write_bytes(MAGIC + packed(changed, *whole[:2]))
        with pytest.raises(StoreError, match="is damaged"):
            RecordReader(tmp_path / "x.inputs")


def test_bytes_that_match_their_checksum_and_are_no_records_are_said_too(run: Path, tmp_path: Path) -> None:
    whole = recorded_of(run, "planner-t0")
    at = next(n for n, each in enumerate(whole) if isinstance(each, Handled) and each.kind == "Heard")
    heard = whole[at]
    assert isinstance(heard, Handled)
    for number, wrong in enumerate(
        (
            msgspec.structs.replace(heard, payload=b"\xff"),
            msgspec.structs.replace(heard, payload=b""),
            msgspec.structs.replace(heard, kind="Nothing"),
            msgspec.structs.replace(heard, kind="Replied"),
            msgspec.structs.replace(heard, kind="JobDone", rest=("tag", 0, "soon", [])),
            msgspec.structs.replace(heard, topic="nothing"),
            msgspec.structs.replace(heard, chunks=["a"] * 9),
            whole[0],
        )
    ):
        folder = rewritten(run, tmp_path / f"{number}", "planner-t0", [*whole[:at], wrong, *whole[at + 1 :]])
        (found,) = replay_run(folder)
        assert found.outcome is None
        assert found.why is not None


def test_a_full_recording_says_so_and_agrees_until_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_file.RecordWriter.__init__, "__defaults__", (5_000,))
    record(tmp_path, 4, 2)
    found = list(replay_run(tmp_path))
    assert any("at most" in each.outcome.ended for each in found if each.outcome is not None)
    assert all(each.same for each in found)
    assert all(each.recorded.path.stat().st_size < 5_200 for each in found)


def test_a_full_disk_cuts_the_recording_and_not_the_run(tmp_path: Path) -> None:
    (tmp_path / "inputs").write_text("no folder")
    simulate(SMALL, 4, 1, record_to=tmp_path)
    with pytest.raises(ConfigError, match="no recorded inputs"):
        recordings_of(tmp_path)


def test_a_replay_ends_at_the_time_that_is_asked_for(run: Path) -> None:
    outcomes = [each.outcome for each in replay_run(run, "planner-t1", 3.0) if each.same]
    assert any(outcome is not None and 2.5 < outcome.seconds <= 3.0 for outcome in outcomes)


def test_the_command_says_what_is_the_same_and_exits_with_1_if_something_differs(run: Path, tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["replay", str(run), "--process", "keeper-0", "--json"])
    assert told.exit_code == 0, told.output
    found = json.loads(told.stdout)
    assert [each["same"] for each in found["processes"]] == [True] * len(found["processes"])
    whole = recorded_of(run, "keeper-0")
    at = max(n for n, each in enumerate(whole) if isinstance(each, Outputs))
    other = rewritten(run, tmp_path / "other", "keeper-0", [*whole[:at], *whole[at + 1 :]])
    told = CliRunner().invoke(app, ["replay", str(other), "--process", "keeper-0"])
    assert told.exit_code == 1
    assert "differs at event" in told.stdout
    assert "recorded: nothing more" in told.stdout
    assert max(map(len, told.stdout.splitlines()[:2])) <= 80
    with pytest.raises(ConfigError, match="no process 'planner-x'"):
        recordings_of(run, "planner-x")


def test_all_that_a_process_is_started_with_is_recorded() -> None:
    # The folder of a process's files, their former owner, and the receiver of its health are no input: the content
    # that it reads there is.
    here = {"run_dir", "record_inputs", "health", "takes_over"}
    assert {field.name for field in dataclasses.fields(RoleSetup)} - here <= set(
        recording_file.Head.__struct_fields__
    )
