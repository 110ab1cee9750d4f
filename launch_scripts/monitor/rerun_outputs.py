"""Outputs of drawing: a pen, and the file, the port and the page to which its strokes go.

Texts of others are shown so that they do nothing but stand there. Rerun's headless viewer ends on a character that
its fonts lack, and its text panel reads Markdown, where an image may be fetched. Ids are safe by their characters;
what an alarm or a note says, or what a zone is called, may be anything.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import secrets
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from launch_scripts.monitor.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.web import LOOPBACK
from launch_scripts.web.http_server import Audience
from launch_scripts.web.live_page import LivePage, when_free
from swarm.clock import NS_PER_S
from swarm.config.scenario import MonitorConfig
from swarm.errors import StoreError
from swarm.files import check_writable, writing

log = logging.getLogger(__name__)

_MEMORY = "4MiB"
"""Limit of the stream's store for later viewers; the oldest goes first. About as much as everything once: a viewer
comes to what is drawn for it only after all of this, on bare ground."""
_PACK_S = 1.0
"""Interval at which rerun packs logged data of an entity into one chunk, unless the service flushes it for viewers.
Ten chunks a second take its threads five times the CPU, and twice the space."""
STILL_CHECKS = 5
"""Checks in a row, one a second, that find the file as long as before: something is drawn every second."""
_RETRY_S = 10.0
"""Pause after a failure to write. Chosen, not measured."""
_SPACE_BYTES = 8 << 20
"""Space from which on a new recording is begun."""

T = TypeVar("T")
Colour = tuple[int, int, int]
LABEL_COLOUR: Colour = (240, 243, 246)
"""Nearly white, on the dark ground of the view."""
_UNSHOWN = re.compile(r"[^ -~]+")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#!~&$])")
_LONGEST = 300
"""Characters of a log line or a heading. Names and texts come from the network, and none of them is to fill a
panel."""


def inline(text: str, most: int = _LONGEST) -> str:
    """A text in one line of characters that every viewer has; `?` stands for others."""
    line = _UNSHOWN.sub("?", " ".join(text.split()))
    return line if len(line) <= most else line[: most - 3] + "..."


def in_markdown(text: str) -> str:
    """The same where Markdown is read: it says itself and does nothing."""
    return _MARKDOWN.sub(r"\\\1", inline(text))


class Strips(NamedTuple):
    """Lines of several points each, as rerun keeps them: of a list of lines it makes an array each, which took a
    third of a frame.

    points   float32 (m, 3), of all lines
    offsets  int32 (n + 1,): line n has points[offsets[n] : offsets[n + 1]]
    """

    points: Floats
    offsets: NDArray[np.int32]


def ragged(points: Floats, lengths: Sequence[int]) -> Strips:
    """Lines of these lengths, one after the other."""
    return Strips(points, np.cumsum([0, *lengths], dtype=np.int32))


def even(points: Floats) -> Strips:
    """float32 (n, m, 3): n lines of m points each."""
    count, each, _ = points.shape
    return ragged(points.reshape(-1, 3), [each] * count)


def screen(radius: float) -> float:
    """A radius in points of the viewer's window, the same at every zoom: rerun takes negative radii so."""
    return -radius


class Pen:
    """Draws on one recording stream, on one terrain. Style is logged once, of the rest only differences from the
    last log: part by part, as rerun keeps parts that are not logged again.

    rerun's viewer tells of the instance under the pointer what its components say, if they are three at most, else
    how many there are. Balls therefore have three: a position, a colour, and a sentence. Their radii are in the
    blueprint.
    """

    def __init__(self, streams: list[rr.RecordingStream], mesh: TerrainMesh) -> None:
        """The same is logged to each of the streams; others may be there the next time."""
        self.streams, self.mesh = streams, mesh
        self._last: dict[tuple[str, str], Any] = {}

    def log(self, entity: str, *parts: rr.AsComponents, static: bool = False) -> None:
        """Logs archetypes of rerun's."""
        for stream in self.streams:
            stream.log(entity, *parts, static=static)

    def set_time(self, frame: int, seconds: float) -> None:
        """Sets the time of all that follows. Data logged before the first call is on no timeline."""
        for stream in self.streams:
            stream.set_time("tick", sequence=frame)
            stream.set_time("sim_time", duration=seconds)

    def flush(self) -> None:
        """Sends logged data to viewers: else rerun packs the data of a second together."""
        for stream in self.streams:
            stream.flush(timeout_sec=0)

    def forget(self) -> None:
        """All is logged once more, when it is drawn."""
        self._last.clear()

    def news(self, entity: str, **parts: Any) -> dict[str, Any]:
        """Those parts of an entity which are not None and differ from what they were."""
        fresh = {
            name: part
            for name, part in parts.items()
            if part is not None and not _same(self._last.get((entity, name)), part)
        }
        self._last.update({(entity, name): part for name, part in fresh.items()})
        return fresh

    def placed(self, places_m: Sequence[tuple[float, float]], above: float) -> Floats:
        """Returns positions, east and south in metres, as points at this height (`scale_m`) over the ground,
        float32 (n, 3)."""
        east_south = np.array(places_m, np.float32).reshape(-1, 2)
        return self.mesh.place(east_south[:, 0], east_south[:, 1], above * self.mesh.scale_m)

    def style(self, entity: str, radius: float, colour: Colour | None = None) -> None:
        """Logs the style of lines, which never changes."""
        colours = None if colour is None else [colour]
        style = rr.LineStrips3D.from_fields(colors=colours, radii=[screen(radius)])
        self.log(entity, style, static=True)

    def label_style(self, entity: str, colour: Colour = LABEL_COLOUR) -> None:
        """An entity is labels that are always shown."""
        style = rr.Points3D.from_fields(colors=[colour], radii=[screen(0.1)], show_labels=True)
        self.log(entity, style, static=True)

    def points(self, entity: str, sentences: Mapping[str, list[str] | None] | None = None, **parts: Any) -> None:
        """Points with these fields of rerun's; sentences by the name of their component."""
        fresh = self.news(entity, **parts)
        if "labels" in fresh:
            fresh["labels"] = pa.array(fresh["labels"], pa.string())
        changed = self.news(entity, **(sentences or {}))
        changed = {name: pa.array(each, pa.string()) for name, each in changed.items()}
        if fresh or changed:
            more = [rr.AnyValues(**changed)] if changed else []
            self.log(entity, rr.Points3D.from_fields(**fresh), *more)

    def lines(self, entity: str, strips: Strips, colours: Bytes | None = None) -> None:
        """Lines; colours are those of each, uint8 (n, 3), or stay as they are."""
        if self.news(entity, points=strips.points, offsets=strips.offsets, colours=colours):
            self.trail(entity, strips, colours)

    def trail(self, entity: str, strips: Strips, colours: Bytes | None) -> None:
        """Lines beside those that were logged before. In rerun's own layout, without an array for each line."""
        wanted = rr.components.LineStrip3DBatch._ARROW_DATATYPE
        points = pa.array(np.ascontiguousarray(strips.points, np.float32).reshape(-1))
        triples = pa.FixedSizeListArray.from_arrays(points, type=wanted.value_type)
        lines = pa.ListArray.from_arrays(pa.array(strips.offsets), triples, type=wanted)
        self.log(entity, rr.LineStrips3D.from_fields(strips=lines, colors=colours))


def _same(one: Any, other: Any) -> bool:
    return np.array_equal(one, other) if isinstance(other, np.ndarray) else bool(one == other)


def new_recording_path(folder: Path) -> Path:
    """`run.rrd`, or `run-2.rrd` and so on where an earlier monitor left one: no file is overwritten."""
    for n in range(1, 10_000):
        path = folder / ("run.rrd" if n == 1 else f"run-{n}.rrd")
        with writing(path), contextlib.suppress(FileExistsError):
            path.open("xb").close()
            return path
    raise StoreError(f"{folder} is full of recordings")


class Sinks:
    """A recording stream and its sinks. `close` takes seconds at most, even if a disk or a viewer hangs."""

    def __init__(
        self,
        recording_id: str,
        path: Path | None,
        config: MonitorConfig,
        blueprint: rrb.Blueprint,
        page: LivePage | None = None,
    ) -> None:
        """The page is one that is served already; without it, one is opened here."""
        self._recording_id = recording_id
        self._blueprint = blueprint
        self._path = path
        self._size, self._still = -1, 0
        """Bytes of the file, and checks that found as many, without a break."""
        self._limit = RateLimit({"look": 1.0, "try": _RETRY_S})
        self.rec = self._stream()
        self.streams = [self.rec]
        """Streams to log to: `rec`, and the file that was begun last, if the first has ended."""
        self.page: LivePage | None = None
        """The known door to the stream, for browsers and native viewers. rerun lets pages read its answers only if
        their Origin is on loopback, but looks at no Host. rerun therefore listens on a random loopback address."""
        live: list[rr.GrpcServerSink] = []
        if config.live:
            host, port = behind = _hidden_address()
            self.page = page or when_free(lambda: LivePage(config.web_port))
            self.page.server.behind = behind
            live.append(rr.GrpcServerSink(bind_ip=host, port=port, server_memory_limit=_MEMORY))
        try:
            self.rec.set_sinks(*_files(path), *live, default_blueprint=blueprint)
        except RuntimeError as error:  # no space on the disk: `check_file` begins another later
            if path is None:
                raise
            log.warning("recording nothing in %s: %s", path, error)
            self.rec.set_sinks(*live, default_blueprint=blueprint)

    @property
    def web_port(self) -> int:
        """Port of the live view's page on this machine; 0 without one."""
        return 0 if self.page is None else self.page.server.port

    def audience(self) -> Audience:
        """Viewers of the stream, and one whose page has not come to it yet."""
        if self.page is None:
            return Audience(now=0, ever=0)
        streams = self.page.server.audience()
        return Audience(streams.now or int(self.page.is_open), streams.ever)

    def check_file(self, now_ns: int) -> Path | None:
        """Notices that the file has ended for want of space, and begins another when there is some. Returns that
        one, which is empty yet.

        Rerun's file sink ends at the first error, with a line in its own log only. The launcher says that the disk
        is full (`DiskWatch`).
        """
        path, limit = self._path, self._limit
        if path is None or not (limit.due("look", now_ns) and self._has_ended(path) and limit.due("try", now_ns)):
            return None
        with contextlib.suppress(StoreError):
            check_space(path.parent)
            self._path = new_recording_path(path.parent)
            self.begin_file(self._path)
            self._size, self._still = -1, 0
            return self._path
        return None

    def _has_ended(self, path: Path) -> bool:
        before = self._size
        with contextlib.suppress(OSError):
            self._size = path.stat().st_size
        self._still = self._still + 1 if self._size == before else 0
        return self._still >= STILL_CHECKS

    def begin_file(self, path: Path) -> None:
        """Sends later logs of `streams` to this file, too. On a stream of its own: new sinks for `rec` would close
        the live view's port. Raises StoreError where nothing can be written to it."""
        _, *earlier = self.streams
        stream = self._stream()
        try:
            stream.set_sinks(*_files(path), default_blueprint=self._blueprint)
        except RuntimeError as error:
            raise StoreError(f"cannot write {path}: {error}") from error
        self.streams[1:] = [stream]
        for each in earlier:
            each.disconnect()

    def _stream(self) -> rr.RecordingStream:
        packing = rr.ChunkBatcherConfig(flush_tick=_PACK_S)
        return rr.RecordingStream("terrain-swarm", recording_id=self._recording_id, batcher_config=packing)

    def close(self, within_s: float = 3.0) -> None:
        written = _in_time(lambda: self._flush(within_s), within_s)
        if self.page is not None:
            self.page.server.close()
        # Only now, as it would take who still watches back to the beginning.
        if not written or not _in_time(self._let_play, 1.0):
            log.warning("the recording was not written to the end within %.0f s", within_s)

    def _flush(self, within_s: float) -> None:
        for stream in reversed(self.streams):
            with contextlib.suppress(Exception):  # a viewer that has left must not keep the file from its end
                stream.flush(timeout_sec=within_s * 0.8)

    def _let_play(self) -> None:
        """Makes viewers open the recording at its beginning and play it: the live view follows its end."""
        if (panel := self._blueprint.time_panel) is not None:
            panel.play_state = "playing"
        for stream in reversed(self.streams):
            with contextlib.suppress(Exception):  # as above
                stream.send_blueprint(self._blueprint, make_active=True, make_default=True)
                stream.flush(timeout_sec=0.8)
            stream.disconnect()


class RateLimit:
    """Due times of several actions, each at its own rate.

    every_s  name -> seconds from one time to the next
    """

    def __init__(self, every_s: Mapping[str, float]) -> None:
        self._every_ns = {name: int(seconds * NS_PER_S) for name, seconds in every_s.items()}
        self.all_due()

    def all_due(self) -> None:
        """Makes every action due, whenever it was done last."""
        self._next_ns = dict.fromkeys(self._every_ns, 0)

    def due(self, name: str, now_ns: int, slower: int = 1) -> bool:
        """Returns True if it is time; if so, the next time is counted from now, later by this factor."""
        if now_ns < self._next_ns[name]:
            return False
        self._next_ns[name] = now_ns + slower * self._every_ns[name]
        return True


def check_space(folder: Path) -> None:
    """Raises StoreError if there is no space for a recording. It is tried by writing, as there are quotas and
    limits that nothing else shows; but only where that does not fill the disk for all others meanwhile."""
    with writing(folder):
        left = os.statvfs(folder)
        if left.f_bavail * left.f_frsize < 2 * _SPACE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    check_writable(folder, _SPACE_BYTES)


def _files(path: Path | None) -> list[rr.FileSink]:
    """A file without a footer, if there is to be one. For that rerun keeps an entry of every chunk in memory up to
    the end, 4 MB a minute of the demo. Readers of recordings accept files without one, too: a killed monitor leaves
    one in any case."""
    return [] if path is None else [rr.FileSink(path, write_footer=False)]


def _in_time(work: Callable[[], None], within_s: float) -> bool:
    """True if the work is done in time; else it goes on beside."""
    thread = threading.Thread(target=work, name="flush", daemon=True)
    thread.start()
    thread.join(within_s)
    return not thread.is_alive()


def _hidden_address() -> tuple[str, int]:
    """Returns an address on loopback that cannot be guessed, if the system has more than one there."""
    host = f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(254) + 1}.{secrets.randbelow(254) + 1}"
    with socket.socket() as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            probe.bind((LOOPBACK, 0))
        address, port = probe.getsockname()
        return str(address), int(port)
