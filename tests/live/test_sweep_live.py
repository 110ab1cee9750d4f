"""`swarm study run` on a cluster of this machine: nothing is lost by a worker or a sweep that is killed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from support.processes import eventually, in_session
from support.small_study import STUDY, dies_of_seed_one, write_study

from launch_scripts.simulation import study_sweep
from launch_scripts.simulation.study import load_study, plan
from launch_scripts.simulation.study_sweep import RESULTS, ResultStore, Sweep, client_of, local_client, run_trials
from launch_scripts.simulation.trials import run_trial
from swarm.errors import BusError

pytestmark = [pytest.mark.network, pytest.mark.timeout(280)]
COMMAND = (sys.executable, "-c", "import sys; from launch_scripts.entry import main; sys.exit(main())")


def test_a_worker_that_is_killed_loses_no_trial_and_changes_no_result(tmp_path: Path):
    trials = [trial for case in plan(load_study(write_study(tmp_path)), tmp_path, "x") for trial in case.trials]
    found: dict[str, dict[str, float]] = {}
    with local_client(2) as client:
        assert client.scheduler_info()["address"].startswith("tcp://127.0.0.1:")
        pids = sorted(client.run(os.getpid).values())
        for trial, result in run_trials(client, trials):
            found[trial.key] = result.figures
            if len(found) == 1:
                os.kill(pids[0], signal.SIGKILL)
    assert found == {trial.key: run_trial(trial).figures for trial in trials}
    assert not any(map(psutil.pid_exists, pids))


@pytest.mark.thorough
def test_a_trial_that_kills_its_workers_is_given_up_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trials = plan(load_study(write_study(tmp_path)), tmp_path, "x")[0].trials
    monkeypatch.setattr(study_sweep, "run_trial", dies_of_seed_one)
    monkeypatch.setitem(study_sweep._SETTINGS, "distributed.scheduler.allowed-failures", 1)
    with local_client(1) as client:
        found = {trial.seed: result for trial, result in run_trials(client, trials)}
    assert found.keys() == {0, 1, 2}
    assert [seed for seed, result in found.items() if result is None] == [1]


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, *(pytest.param(each, marks=pytest.mark.thorough) for each in (signal.SIGTERM, signal.SIGKILL))],
)
def test_a_sweep_that_is_stopped_keeps_what_it_had_and_goes_on_from_there(tmp_path: Path, number: signal.Signals):
    path, out = write_study(tmp_path, STUDY.replace('"0:3"', '"0:100"')), tmp_path / "out"
    kept_by_now = out / "results.jsonl"
    words = [*COMMAND, "study", "run", str(path), "--workers", "1", "--out", str(out)]
    running = subprocess.Popen(words, stderr=subprocess.PIPE, start_new_session=True, text=True)
    try:
        eventually(lambda: (kept_by_now.exists() and kept_by_now.stat().st_size) or running.poll() is not None, 200)
        if number == signal.SIGINT:
            os.killpg(running.pid, number)  # as a terminal does
        else:
            running.send_signal(number)
        _, said = running.communicate(timeout=200)
    finally:
        running.kill()
    kept = ResultStore(out).results
    assert 0 < len(kept) < 200
    if number != signal.SIGKILL:
        assert running.returncode == 130
        assert f"{len(kept)} of 200 trials are kept in" in said
        assert "Traceback" not in said
    else:
        assert running.returncode == -number
    eventually(lambda: not in_session(running.pid), 200, "the end of its workers")
    sweep = Sweep(path, out)
    assert len(sweep.missing) == 200 - len(kept)
    path.write_text(STUDY.replace('"0:3"', '"0:1"').replace("[60, 120]", "[60]"), encoding="utf-8")
    assert subprocess.run(words, capture_output=True, check=True, timeout=200).returncode == 0
    assert (out / RESULTS).is_file()


def test_a_scheduler_that_is_there_is_used_and_an_absent_one_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trial = plan(load_study(write_study(tmp_path)), tmp_path, "x")[0].trials[0]
    with local_client(1) as there, client_of(there.scheduler_info()["address"]) as client:
        [(_, result)] = run_trials(client, [trial])
        assert result.key == trial.key
    monkeypatch.setattr(study_sweep, "_CONNECT_S", 0.5)
    with pytest.raises(BusError, match="no scheduler of Dask answers"), client_of("tcp://127.0.0.1:1"):
        pass
