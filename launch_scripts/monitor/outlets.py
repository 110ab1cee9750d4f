"""Where the recording goes: a file, and viewers on this machine."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from launch_scripts.monitor import tied
from swarm.config import MonitorConfig
from swarm.errors import BusError, StoreError

log = logging.getLogger(__name__)

APPLICATION = "terrain-swarm"
_LOOPBACK = "127.0.0.1"
_PORT_PATIENCE_S = 3.0


def new_recording_path(folder: Path) -> Path:
    """`run.rrd`, or `run-2.rrd` and so on where an earlier monitor left one: nothing is ever overwritten."""
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


class Outlets:
    """A recording stream and where it flows. `close` takes seconds at most, whatever a disk or a viewer does."""

    def __init__(
        self, recording_id: str, path: Path | None, config: MonitorConfig, blueprint: rrb.Blueprint
    ) -> None:
        self.rec = rr.RecordingStream(
            APPLICATION, recording_id=recording_id, batcher_config=rr.ChunkBatcherConfig(flush_tick=0.1)
        )
        self.live_url: str | None = None
        self._viewer: subprocess.Popen[bytes] | None = None
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        if path is not None:
            sinks.append(rr.FileSink(path, write_footer=True))
        if config.live:
            grpc_port, web_port = _port(config.grpc_port, "grpc_port"), _port(config.web_port, "web_port")
            sinks.append(
                rr.GrpcServerSink(bind_ip=_LOOPBACK, port=grpc_port, server_memory_limit=f"{config.memory_mib}MiB")
            )
        self.rec.set_sinks(*sinks, default_blueprint=blueprint)
        if config.live:
            grpc_url = f"rerun+http://{_LOOPBACK}:{grpc_port}/proxy"
            self._viewer = _serve_viewer(web_port, grpc_url)
            escaped = grpc_url.replace("+", "%2B")
            self.live_url = f"http://{_LOOPBACK}:{web_port}/?url={escaped}"

    def close(self, within_s: float = 3.0) -> None:
        closing = threading.Thread(target=self._flush, args=(within_s,), name="flush", daemon=True)
        closing.start()
        closing.join(within_s)
        if closing.is_alive():
            log.warning("the recording was not written to the end within %.0f s", within_s)
        if self._viewer is not None:
            self._viewer.kill()
            self._viewer.wait()

    def _flush(self, within_s: float) -> None:
        with contextlib.suppress(Exception):  # a viewer that is gone must not keep the file from its end
            self.rec.flush(timeout_sec=within_s * 0.8)
        self.rec.disconnect()


def _port(wanted: int, name: str) -> int:
    """The port if it is free, or becomes free soon as after a restart; any free one if 0 is wanted."""
    deadline_s = time.monotonic() + _PORT_PATIENCE_S
    while True:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((_LOOPBACK, wanted))
                return int(probe.getsockname()[1])
            except OSError as error:
                if time.monotonic() > deadline_s:
                    raise BusError(
                        f"cannot show the live view on port {wanted}: {error.strerror}; choose another "
                        f"monitor.{name}, 0 for any, or monitor.live = false"
                    ) from error
        time.sleep(0.1)


def viewer_program() -> Path:
    """The viewer itself. The script of that name on the path would be a second process between us and it."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise StoreError("rerun's viewer is not installed: install rerun-sdk, or set monitor.live = false")
    return Path(spec.origin).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")


def _serve_viewer(port: int, grpc_url: str) -> subprocess.Popen[bytes]:
    """The web viewer, on loopback only: rerun's own function would serve it to the whole network.

    Given a url, the program serves nothing but the viewer itself. On "CI" it collects no usage data and writes
    nothing to the home folder.
    """
    serve = [str(viewer_program()), "--serve-web", "--bind", _LOOPBACK, "--web-viewer-port", str(port), grpc_url]
    return subprocess.Popen(
        [sys.executable, "-I", str(Path(tied.__file__)), str(os.getpid()), *serve],
        stdin=subprocess.DEVNULL,
        env={**os.environ, "CI": "1", "RUST_LOG": "warn"},
    )
