"""`swarm up` as a process beside this one, for commands which measure or strike a swarm."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from launch_scripts.launcher.takeover import processes
from launch_scripts.parent_death import end_with_parent
from swarm.errors import SwarmError

_END_S = 60.0
_COMMAND = [sys.executable, "-c", "import sys; from launch_scripts.entry import main; sys.exit(main())"]


class UpProcess:
    """A launcher in a session of its own. It is asked to end when this process ends, however that happens; `end`
    waits for it and leaves no process of the run.

    Its output is in `up.log` in the run's folder, its report in `up.json`.
    """

    def __init__(self, scenario: str, run_dir: Path, seconds: float, *words: str) -> None:
        self.run_dir = run_dir
        self._said, self._reported = run_dir / "up.log", run_dir / "up.json"
        command = [*_COMMAND, "up", scenario, "--plain", "--json", "--seconds", f"{seconds:g}"]
        command += ["--runs", str(run_dir.parent), "--run-id", run_dir.name, *words]
        with self._said.open("wb") as said, self._reported.open("wb") as reported:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=reported,
                stderr=said,
                start_new_session=True,
                preexec_fn=lambda: end_with_parent(signal.SIGINT),
            )

    @property
    def session(self) -> int:
        """The session of the launcher and of all that it starts."""
        return self.process.pid

    def lines(self) -> list[str]:
        """The output of the launcher until now."""
        with contextlib.suppress(OSError):
            return self._said.read_text(errors="replace").strip().splitlines()
        return []

    def check(self) -> None:
        """Raises SwarmError, with the launcher's exit code and last sentence, if it has ended."""
        code = self.process.poll()
        if code is not None:
            last = (self.lines() or ["it said nothing"])[-1]
            error = SwarmError(f"the launcher ended with code {code}: {last.removeprefix('swarm: ')}")
            error.exit_code = code if code > 0 else 1
            raise error

    def report(self) -> dict[str, Any] | None:
        """The report of the launcher at its end; None if there is none."""
        with contextlib.suppress(OSError, ValueError):
            found: dict[str, Any] = json.loads(self._reported.read_text())
            return found
        return None

    def end(self) -> list[str]:
        """Asks the launcher to end and waits for it. Returns the names of processes that had to be killed."""
        left_behind = []
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(_END_S)
            except subprocess.TimeoutExpired:
                left_behind.append("the launcher")
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait(10)
        for name, pid in processes(self.run_dir).items():
            left_behind.append(name)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return left_behind
