"""Logs of bounded size, with dates, as text or JSON, which a full disk cannot harm."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, Literal, NamedTuple

from launch_scripts.plain_text import plain

LogFormat = Literal["text", "json"]

MAX_BYTES = 16 << 20
"""A longer log is renamed to NAME.1, in the place of the previous one, and begun again."""


class _Format(logging.Formatter):
    """Begins a line with date, time and zone: logs of several machines are read side by side. A message is one
    line, and nothing in it is obeyed by a terminal."""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # noqa: N802
        return datetime.fromtimestamp(record.created).astimezone().isoformat(" ", "milliseconds")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        record.message = plain(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:  # noqa: N802
        return "\n".join(map(plain, super().formatException(ei).split("\n")))


FORMAT = _Format("%(asctime)s %(levelname)-7s %(name)s: %(message)s")


class Speaker(NamedTuple):
    """Author of a log."""

    role: str
    id: str
    run: str


class JsonLines(logging.Formatter):
    """One JSON object a line, in ASCII: no text of a file or of the network begins a line of its own, or is obeyed
    by a terminal. Fields are `time` (RFC 3339, UTC), `level`, `role`, `id`, `run`, `logger`, `message`, and
    `exception`, a traceback, where there is one."""

    def __init__(self, speaker: Speaker | None = None) -> None:
        super().__init__()
        self._speaker = {} if speaker is None else speaker._asdict()

    def format(self, record: logging.LogRecord) -> str:
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        fields = {
            "time": time.replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            **self._speaker,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        if record.stack_info:
            fields["stack"] = record.stack_info
        return json.dumps(fields)


class LogFile(RotatingFileHandler):
    """Appends to a file, which is opened at the first line. Lines that cannot be written are counted, and reported
    when there is space again.

    takes_output  standard output and error of this process, that of native libraries included, go to the file too
    """

    def __init__(self, path: Path, *, takes_output: bool = False) -> None:
        self._takes_output = takes_output
        self._lost = 0
        """Lines that could not be written, since one could."""
        super().__init__(path, maxBytes=MAX_BYTES, backupCount=1, encoding="utf-8", delay=True)

    def _open(self):  # type: ignore[no-untyped-def]  # the type of the stream is the library's own
        stream = super()._open()
        if self._takes_output:
            os.dup2(stream.fileno(), 1)
            os.dup2(stream.fileno(), 2)
        return stream

    def emit(self, record: logging.LogRecord) -> None:
        before = self._lost
        super().emit(record)
        if before and self._lost == before:
            self._lost = 0
            notice = logging.LogRecord(__name__, logging.WARNING, "", 0, "%d lines were lost", (before,), None)
            super().emit(notice)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (the library calls it so)
        if isinstance(sys.exc_info()[1], OSError):
            self._lost += 1
        else:
            super().handleError(record)


def log_to(
    path: Path | None, format: LogFormat = "text", speaker: Speaker | None = None, *, takes_output: bool = False
) -> None:
    """Logs to a file, or to standard error if there is none.

    speaker  process that writes the log, if known. Also sets the title of this process, as the system's `ps` and
             `top` show it
    """
    if speaker is not None:
        with contextlib.suppress(ImportError):  # of a small install
            from setproctitle import setproctitle

            setproctitle(f"swarm: {speaker.role} {speaker.id} (run {speaker.run})")
    handler = logging.StreamHandler(sys.stderr) if path is None else LogFile(path, takes_output=takes_output)
    handler.setFormatter(JsonLines(speaker) if format == "json" else FORMAT)
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
