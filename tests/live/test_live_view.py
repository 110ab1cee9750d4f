"""The view of a person: the live view in a real browser, and in rerun's own viewer."""

import contextlib
import importlib.util
import io
import os
import subprocess
import time
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray
from support.devtools import CHROMIUM, Browser, BrowserError
from support.fake_run import fake_run
from support.monitor_rig import LIVE, Rig, hidden_truth, little_scenario, little_terrain
from support.processes import eventually

from launch_scripts.monitor.live_layout import BACKGROUND
from launch_scripts.ports import free_ports
from launch_scripts.web.live_page import viewer_program

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SIZE = (1280, 800)
VULKAN = [path for folder in ("/usr/share", "/etc") for path in Path(folder, "vulkan/icd.d").glob("*.json")]


@pytest.fixture(scope="module")
def shown() -> Iterator[Rig]:
    """A run that was, and a monitor that still serves it."""
    scenario, terrain = little_scenario(), little_terrain()
    rig = Rig(scenario, terrain, None, config=LIVE)
    rig.play(fake_run(terrain, hidden_truth(terrain), scenario))
    yield rig
    rig.close()


def seen(picture: bytes) -> dict[str, int]:
    """Pixels of the 3D view by what they show: ground, and each target with its vehicles, routes and trails."""
    pixels: NDArray[np.int_] = (imread(io.BytesIO(picture), format="png")[..., :3] * 255).astype(int)
    view = pixels[40:-60, : round(pixels.shape[1] * 0.68)]
    red, green, blue = view[..., 0], view[..., 1], view[..., 2]
    background = (np.abs(view - np.array(BACKGROUND)) < 12).all(axis=-1)
    return {
        "background": int(background.sum()),
        "ground": int((~background).sum()),
        "t0": int(((blue > 130) & (blue > red + 60) & (blue > green + 20)).sum()),
        "t1": int(((red > 130) & (red > blue + 80) & (red > green + 20) & (green > blue + 20)).sum()),
    }


def complete(picture: bytes) -> bool:
    counts = seen(picture)
    return counts["background"] > 10_000 and counts["ground"] > 30_000 and counts["t0"] > 20 and counts["t1"] > 20


def wait_until_complete(screenshot: Callable[[], bytes], folder: Path, within_s: float) -> None:
    last = folder / "last.png"

    def shown() -> bool:
        with contextlib.suppress(BrowserError, TimeoutError):
            last.write_bytes(screenshot())
            return complete(last.read_bytes())
        return False

    eventually(shown, within_s, f"the complete view, of which {last} is the last picture,", every_s=1.0)


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium")
def test_a_browser_shows_ground_targets_and_vehicles_and_asks_no_one_else(shown: Rig, tmp_path: Path) -> None:
    assert shown.sinks.page is not None
    browser = Browser(tmp_path / "profile", SIZE)
    try:
        browser.open(shown.sinks.page.server.url)
        wait_until_complete(browser.screenshot, tmp_path, within_s=200)
        hosts = {urllib.parse.urlparse(url).hostname for url in browser.reached if url.startswith("http")}
        assert hosts == {"127.0.0.1"}
        elsewhere = [url for url in browser.requested if url.startswith("http") and "//127.0.0.1" not in url]
        assert sorted(elsewhere) == sorted(browser.refused), "what wants out is stopped by the page's policy"
    finally:
        browser.close()


@pytest.mark.skipif(not VULKAN, reason="needs a Vulkan driver: apt-get install mesa-vulkan-drivers")
@pytest.mark.skipif(importlib.util.find_spec("rerun_cli") is None, reason="needs rerun's viewer")
def test_the_native_viewer_shows_the_same(shown: Rig, tmp_path: Path) -> None:
    from rerun.experimental import ViewerClient

    location, port = f"rerun+{shown.sinks.page.server.url}/proxy", free_ports(1)[0]
    viewer = subprocess.Popen(
        [viewer_program(), "--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", "1280x800",
         location],
        env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path), "CI": "1", "RUST_LOG": "error"},
    )  # fmt: skip
    try:
        client = connected(ViewerClient, f"rerun+http://127.0.0.1:{port}/proxy")

        def screenshot() -> bytes:
            client.save_screenshot(str(tmp_path / "view.png"))
            return (tmp_path / "view.png").read_bytes()

        wait_until_complete(screenshot, tmp_path, within_s=100)
    finally:
        viewer.kill()
        viewer.wait()


def connected(client_type: Any, url: str) -> Any:
    deadline_s = time.monotonic() + 30
    while True:
        try:
            return client_type.connect(url)
        except Exception:  # it says in many ways that no endpoint listens yet
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.2)
