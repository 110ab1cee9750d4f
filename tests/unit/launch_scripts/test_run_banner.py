"""The banner of the live page for a run that it lags behind, or that is over: our script in a real browser, beside
a viewer whose answers are made here."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.devtools import CHROMIUM, Browser

from launch_scripts.web import live_page as web

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium")

_SCRIPT = Path(web.__file__).with_name("run_banner.js").read_text()
_STUBS = """
window.fetch = async () => {
  if (window.run === null) throw new Error("gone");
  return { json: async () => window.run };
};
window.setInterval = (look) => { window.look = look; };
"""


def field(number: int, value: int | bytes) -> bytes:
    """One field of a protobuf message."""
    if isinstance(value, bytes):
        return varint(number << 3 | 2) + varint(len(value)) + value
    return varint(number << 3) + varint(value)


def varint(value: int) -> bytes:
    digits = bytearray()
    while value > 127:
        digits.append(value & 127 | 128)
        value >>= 7
    return bytes([*digits, value])


def viewer_state(taken_s: float) -> list[int]:
    """The answer of rerun 0.41: a recording, its timelines, each with its name and its first and last time."""

    def timeline(name: str, last: int) -> bytes:
        return field(2, field(1, field(1, name.encode())) + field(2, 2) + field(3, field(1, 0) + field(2, last)))

    recording = field(1, b"Recording:run") + timeline("tick", 7) + timeline("sim_time", int(taken_s * 1e9))
    return list(field(1, b"about:recording") + field(3, recording) + field(6, b"0.41.0"))


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    opened = Browser(tmp_path / "profile", (400, 300))
    try:
        opened.open("about:blank")
        value(opened, _STUBS + _SCRIPT)
        yield opened
    finally:
        opened.close()


def value(browser: Browser, expression: str) -> object:
    told = browser.call("Runtime.evaluate", expression=expression, awaitPromise=True)
    assert "exceptionDetails" not in told, told
    return told["result"].get("value")


def banner(browser: Browser, run: dict[str, object] | None, taken_s: float | None, looks: int = 1) -> object:
    """The text of the banner after some checks."""
    state = "null" if taken_s is None else f"{{viewer_state: () => new Uint8Array({viewer_state(taken_s)})}}"
    value(browser, f"window._handle = {state}; window.run = {json.dumps(run)};")
    for _ in range(looks):
        value(browser, "window.look()")
    return value(browser, "document.getElementById('run-banner').textContent")


def test_the_page_says_when_it_is_behind_and_when_the_run_is_over(browser: Browser) -> None:
    run: dict[str, object] = {"life": "a", "at_s": 60.0, "over": False, "recording": "rerun runs/r/run.rrd"}
    assert banner(browser, run, 59.0, looks=5) == ""
    assert banner(browser, run, 43.0, looks=2) == "", "a moment's delay"
    assert "it has come to 43 s, and the run is at 60 s" in str(banner(browser, run, 43.0))
    assert banner(browser, run, 58.0) == "", "it has caught up"
    assert banner(browser, run, None, looks=3) == "This page is loading; the run is at 60 s."
    whole = " To see the whole run: rerun runs/r/run.rrd"
    assert banner(browser, {**run, "over": True}, 59.5) == f"The run is over, at 60 s.{whole}"
    late = "The run is over, at 60 s. This page has come to 43 s only."
    assert banner(browser, {**run, "over": True}, 43.0) == late + whole
    gone = "The run is over, or cannot be reached; last heard of at 60 s."
    assert banner(browser, None, 59.5, looks=2) == gone + whole
    assert banner(browser, {**run, "life": "b"}, 1.0) == "The view was started anew: reload this page."
    banner(browser, run, 59.0)
    value(browser, "window._handle = {viewer_state: () => new Uint8Array([255, 255])}")
    value(browser, "window.look().then(look).then(look).then(look)")
    said = value(browser, "document.getElementById('run-banner').textContent")
    assert said == "", "a viewer that tells otherwise is no viewer that is late"
