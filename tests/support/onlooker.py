"""A program on a machine of its own that notes what a swarm says of itself: `onlooker_program`, line by line."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from support import onlooker_program
from support.machines import Machines

ENDS_S = 600.0


class Onlooker:
    """`notes` holds its latest values; see `onlooker_program.Notes`."""

    def __init__(self, machines: Machines, name: str, scenario: Path, endpoint: str, certificates: Path) -> None:
        command = [sys.executable, str(onlooker_program.__file__), str(scenario), endpoint, str(certificates)]
        self.notes: dict[str, Any] = {}
        self._process = machines.start(name, [*command, str(ENDS_S)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.notes = json.loads(line)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(20)
        self._reader.join(20)
