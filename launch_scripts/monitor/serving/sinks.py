"""Sinks of the recording: a file, and viewers on this machine."""

from __future__ import annotations

import contextlib
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import rerun as rr
import rerun.blueprint as rrb

from launch_scripts.web.loopback_guard import LOOPBACK, Audience
from launch_scripts.web.stream_gate import StreamGate
from launch_scripts.web.view_page import ViewerPage
from swarm.config.scenario import MonitorConfig
from swarm.errors import BusError, StoreError

log = logging.getLogger(__name__)

APPLICATION = "terrain-swarm"
_PORT_PATIENCE_S = 3.0
_MEMORY = "64MiB"
"""What the stream keeps for viewers that come later; the oldest goes first. The process grows by twice as much."""

_PACK_S = 1.0
"""Within this time rerun packs what is logged of an entity into one chunk, unless the service flushes it for those
who watch. Ten chunks a second take its threads five times the CPU, and twice the space."""

T = TypeVar("T")


def new_recording_path(folder: Path) -> Path:
    """`run.rrd`, or `run-2.rrd` and so on where an earlier monitor left one: no file is overwritten."""
    for n in range(1, 10_000):
        path = folder / ("run.rrd" if n == 1 else f"run-{n}.rrd")
        try:
            path.open("xb").close()
            return path
        except FileExistsError:
            continue
        except OSError as error:
            raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    raise StoreError(f"{folder} is full of recordings")


def _files(path: Path | None) -> list[rr.FileSink]:
    """A file without a footer, if there is to be one. For that rerun keeps an entry of every chunk in memory up to
    the end, 4 MB a minute of the demo. What reads recordings reads those without one, too: a killed monitor leaves
    one in any case."""
    return [] if path is None else [rr.FileSink(path, write_footer=False)]


class Streams:
    """Recording streams to which the same is logged."""

    def __init__(self, *streams: rr.RecordingStream) -> None:
        self.streams = streams

    def log(self, path: str, *what: Any, static: bool = False) -> None:
        for stream in self.streams:
            stream.log(path, *what, static=static)

    def set_time(self, timeline: str, **when: Any) -> None:
        for stream in self.streams:
            stream.set_time(timeline, **when)

    def flush(self, *, timeout_sec: float) -> None:
        for stream in self.streams:
            stream.flush(timeout_sec=timeout_sec)


class Sinks:
    """A recording stream and its sinks. `close` takes seconds at most, even if a disk or a viewer hangs."""

    def __init__(
        self, recording_id: str, path: Path | None, config: MonitorConfig, blueprint: rrb.Blueprint
    ) -> None:
        self._recording_id = recording_id
        self._blueprint = blueprint
        self.rec = self._stream()
        self.streams = Streams(self.rec)
        """Where to log: `rec`, and the file that was begun last, if the first has ended."""
        self.stream_url: str | None = None
        """Address for a native viewer."""
        self._page: ViewerPage | None = None
        self._gate: StreamGate | None = None
        live: list[rr.GrpcServerSink] = []
        if config.live:
            behind = _hidden_address()
            self._gate = _when_free(lambda port: StreamGate(port, behind), config.grpc_port, "grpc_port")
            threading.Thread(target=self._gate.serve_forever, name="stream-gate", daemon=True).start()
            self.stream_url = f"rerun+http://{LOOPBACK}:{self._gate.port}/proxy"
            page = _when_free(lambda port: ViewerPage(port, behind), config.web_port, "web_port")
            self._page = page
            live.append(rr.GrpcServerSink(bind_ip=behind[0], port=behind[1], server_memory_limit=_MEMORY))
        try:
            self.rec.set_sinks(*_files(path), *live, default_blueprint=blueprint)
        except (
            RuntimeError
        ) as error:  # a disk without space: `RecordingWatch` begins another file once there is some
            if path is None:
                raise
            log.warning("recording nothing in %s: %s", path, error)
            self.rec.set_sinks(*live, default_blueprint=blueprint)

    @property
    def live_url(self) -> str | None:
        """Address for a browser on this machine."""
        return None if self._page is None else f"http://{LOOPBACK}:{self._page.port}/"

    @property
    def web_port(self) -> int:
        """Port of that page; 0 without one."""
        return 0 if self._page is None else self._page.port

    def audience(self) -> Audience:
        """Viewers of the stream."""
        servers = [server.audience() for server in (self._gate, self._page) if server is not None]
        return Audience(sum(each.now for each in servers), sum(each.ever for each in servers))

    def tell_page(self, run: Callable[[], Mapping[str, Any]]) -> None:
        """What the page shows of the run beside the view, asked once a second for each page that is open."""
        if self._page is not None:
            self._page.run = run

    def begin_file(self, path: Path) -> None:
        """Let what is logged to `streams` go to this file, too. On a stream of its own: new sinks for `rec` would
        close the live view's port. Raises StoreError where nothing can be written to it."""
        _, *earlier = self.streams.streams
        stream = self._stream()
        try:
            stream.set_sinks(*_files(path), default_blueprint=self._blueprint)
        except RuntimeError as error:
            raise StoreError(f"cannot write {path}: {error}") from error
        self.streams.streams = (self.rec, stream)
        for each in earlier:
            each.disconnect()

    def _stream(self) -> rr.RecordingStream:
        return rr.RecordingStream(
            APPLICATION, recording_id=self._recording_id, batcher_config=rr.ChunkBatcherConfig(flush_tick=_PACK_S)
        )

    def close(self, within_s: float = 3.0) -> None:
        written = _in_time(lambda: self._flush(within_s), within_s)
        if self._page is not None:
            self._page.close()
        if self._gate is not None:
            self._gate.close()
        # Only now, as it would take who still watches back to the beginning.
        if not written or not _in_time(self._let_play, 1.0):
            log.warning("the recording was not written to the end within %.0f s", within_s)

    def _flush(self, within_s: float) -> None:
        for stream in reversed(self.streams.streams):
            with contextlib.suppress(Exception):  # a viewer that is gone must not keep the file from its end
                stream.flush(timeout_sec=within_s * 0.8)

    def _let_play(self) -> None:
        """Let the recording be opened at its beginning and play: the live view follows its end."""
        if (panel := self._blueprint.time_panel) is not None:
            panel.play_state = "playing"
        for stream in reversed(self.streams.streams):
            with contextlib.suppress(Exception):  # as above
                stream.send_blueprint(self._blueprint, make_active=True, make_default=True)
                stream.flush(timeout_sec=0.8)
            stream.disconnect()


def _in_time(work: Callable[[], None], within_s: float) -> bool:
    """Whether it is done in time. It goes on beside if it is not."""
    thread = threading.Thread(target=work, name="flush", daemon=True)
    thread.start()
    thread.join(within_s)
    return not thread.is_alive()


def _when_free(listen: Callable[[int], T], port: int, name: str) -> T:
    """Listens on a port, and waits for one which is still in use, as after a restart. Raises BusError."""
    deadline_s = time.monotonic() + _PORT_PATIENCE_S
    while True:
        try:
            return listen(port)
        except OSError as error:
            if time.monotonic() > deadline_s:
                raise BusError(
                    f"cannot show the live view on port {port}: {error.strerror}; choose another "
                    f"monitor.{name}, 0 for any, or monitor.live = false"
                ) from error
        time.sleep(0.1)


def _hidden_address() -> tuple[str, int]:
    """An address on loopback that nobody guesses, if the system has more than one there."""
    host = f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(254) + 1}.{secrets.randbelow(254) + 1}"
    with socket.socket() as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            probe.bind((LOOPBACK, 0))
        address, port = probe.getsockname()
        return str(address), int(port)
