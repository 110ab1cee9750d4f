"""`swarm gateway ros2` as a process, a router of the ROS side, and a foreign peer in a process of its own, which is
zenoh-ros2-sdk with definitions written from our types."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import zenoh
from support.live_swarm import SWARM
from support.processes import Child, eventually

from launch_scripts.gateways.ros2.ros_types import REQUEST, RESPONSE, RosTypes
from launch_scripts.ports import free_ports
from swarm.errors import SwarmError

_START_S = 60.0
_PROGRAM = Path(__file__).with_name("ros_peer_program.py")
_LONGEST_S = 120.0
_EMPTY = "uint8 structure_needs_at_least_one_member"


class Gateway(Child):
    """`swarm gateway ros2` between the routers at two endpoints, as users start it. Use it in a `with`, which waits
    until it is in a run, and kills it in the end. Raises SwarmError, with what it said, if it does not start."""

    def __init__(self, swarm: str, ros: str, folder: Path, *words: object) -> None:
        where = ("--connect", swarm, "--ros", ros)
        super().__init__(folder / "ros2.log", *SWARM, "gateway", "ros2", *words, *where)

    def __enter__(self) -> Self:
        with contextlib.suppress(AssertionError):
            eventually(lambda: "run " in self.text or self.process.poll() is not None, _START_S)
        if "run " not in self.text or self.process.poll() is not None:
            self.kill()
            raise SwarmError(f"the gateway does not start: {self.text.strip()}")
        return self


@contextlib.contextmanager
def ros_router(port: int | None = None) -> Iterator[int]:
    """The port of a router in this process, of the kind that rmw_zenohd is: it does not forward between peers."""
    port = port or free_ports(1)[0]
    config = zenoh.Config()
    for key, value in {
        "mode": '"router"',
        "listen/endpoints": f'["tcp/127.0.0.1:{port}"]',
        "scouting/multicast/enabled": "false",
        "routing/router/peers_failover_brokering": "false",
    }.items():
        config.insert_json5(key, value)
    with zenoh.open(config):
        yield port


def write_definitions(folder: Path, types: RosTypes) -> Path:
    """.msg and .srv files of all that is known, as the SDK reads them instead of fetching some."""
    parts = set(types._store.fielddefs)
    for name in parts:
        package, kind, base = name.split("/")
        if kind == "msg":
            _write(folder / package / kind / f"{base}.msg", _own_part(types, name))
        elif (
            kind == "srv" and name.endswith(REQUEST) and (service := name.removesuffix(REQUEST)) + RESPONSE in parts
        ):
            request, response = (_own_part(types, service + part) for part in (REQUEST, RESPONSE))
            _write(folder / package / kind / f"{base.removesuffix(REQUEST)}.srv", f"{request}\n---\n{response}\n")
    return folder


def _own_part(types: RosTypes, name: str) -> str:
    # The SDK refuses empty parts; this member, which every stack adds, has the same hash and bytes.
    return types.definition_of(name).split("=" * 80)[0].strip() or _EMPTY


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


class RosPeer:
    """A peer at a router of this machine. Use it in a `with`; it ends by itself after two minutes, too.

    definitions  `write_definitions`
    """

    def __init__(self, port: int, definitions: Path) -> None:
        environment = os.environ | {"ZENOH_ROS2_SDK_CACHE": str(definitions / "cache")}
        with tempfile.NamedTemporaryFile("w", dir=definitions, suffix=".log", delete=False) as log:
            self._log = Path(log.name)
            self.process = subprocess.Popen(
                [sys.executable, str(_PROGRAM), str(definitions), str(port), str(_LONGEST_S)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=environment,
            )  # fmt: skip
        self.received: dict[str, list[Any]] = {}
        """Topic -> messages as JSON has them, the oldest first."""
        self._other: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self._wait("ready", 30.0)

    def __enter__(self) -> RosPeer:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def hear(self, topic: str, type_name: str) -> None:
        """Subscribes: received messages are in `received`."""
        self.received.setdefault(topic, [])
        self._do("hear", topic=topic, type=type_name)

    def put(self, topic: str, type_name: str, hz: float | None = None, **fields: Any) -> None:
        """Publishes once, or at a rate until the next command; missing fields are 0 or empty."""
        self._do("put", topic=topic, type=type_name, fields=fields, hz=hz)

    def ask(self, service: str, type_name: str, timeout_s: float = 15.0, **fields: Any) -> dict[str, Any]:
        """A service's response as `message`, which is None without one, and `took_ms`."""
        answer = self._do("ask", service=service, type=type_name, fields=fields, timeout_s=timeout_s)
        assert answer is not None
        return answer

    def kill(self) -> None:
        """Kills the process with signal 9."""
        self.process.kill()
        self.process.wait(10)

    def _do(self, word: str, **words: Any) -> dict[str, Any] | None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": word, **words}) + "\n")
        self.process.stdin.flush()
        return self._wait("done", 40.0)

    def _wait(self, word: str, within_s: float) -> dict[str, Any] | None:
        answer = None
        until_s = time.monotonic() + within_s
        while True:
            try:
                reply = self._other.get(timeout=max(until_s - time.monotonic(), 0.01))
            except queue.Empty:
                reply = {"ended": True}
            assert "ended" not in reply, f"the peer did not say {word!r}: {self._log.read_text()}"
            if word in reply:
                return answer
            answer = reply

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            reply = json.loads(line)
            if "received" in reply:
                self.received[reply["received"]].append(reply["message"])
            else:
                self._other.put(reply)
        self._other.put({"ended": True})
