"""Screenshot of a recorded run, such as the README's. Needs a Vulkan driver and no display.

python -m launch_scripts.monitor.serving.screenshot runs/LAST/run.rrd docs/images/live-view.png --at 60
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from launch_scripts.web.loopback_guard import LOOPBACK
from launch_scripts.web.view_page import viewer_program

T = TypeVar("T")
_START_WITHIN_S = 30.0


def take_still(recording: Path, picture: Path, at_s: float | None, size: tuple[int, int], settle_s: float) -> None:
    """Opens a recording in the headless viewer and saves its view, `at_s` seconds into the run."""
    from rerun.experimental import ViewerClient

    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as home:
        show = [str(viewer_program()), "--headless", "--bind", LOOPBACK, "--port", str(port), str(recording)]
        viewer = subprocess.Popen(
            [*show, "--window-size", f"{size[0]}x{size[1]}"],
            env={**os.environ, "HOME": home, "XDG_RUNTIME_DIR": home, "CI": "1", "RUST_LOG": "error"},
        )
        try:
            client = _patiently(lambda: ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy"))
            time.sleep(settle_s)
            if at_s is not None:
                client.set_time("sim_time", duration=at_s, play_state="paused")
                time.sleep(settle_s)
            client.save_screenshot(str(picture))
        finally:
            viewer.kill()
            viewer.wait()


def _patiently(connect: Callable[[], T]) -> T:
    deadline_s = time.monotonic() + _START_WITHIN_S
    while True:
        try:
            return connect()
        except Exception:  # the client raises various errors until the viewer listens
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description="A still of a recorded run.")
    parser.add_argument("recording", type=Path, help="run.rrd")
    parser.add_argument("picture", type=Path, help="the PNG to write")
    parser.add_argument("--at", type=float, help="seconds since the launch; the end if not given")
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1000), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--settle", type=float, default=5.0, help="seconds for the viewer to load and draw")
    args = parser.parse_args()
    take_still(args.recording, args.picture, args.at, tuple(args.size), args.settle)


if __name__ == "__main__":
    main()
