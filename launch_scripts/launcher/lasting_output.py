"""Output that outlives its reader: no run ends because a terminal is closed or `head` has enough."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
from typing import Any, TextIO, cast

log = logging.getLogger(__name__)

_READER_GONE = frozenset((errno.EPIPE, errno.EIO, errno.EBADF, errno.ENXIO))
"""Of a pipe, and of a terminal."""


class LastingOutput(io.TextIOBase):
    """A text stream as it is, until its reader is gone: from then on what is written goes nowhere. Other errors, as
    of a full disk, are raised as ever."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError as error:
            self._survive(error)
        return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._survive(error)

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    def writable(self) -> bool:
        return True

    def __getattr__(self, name: str) -> Any:  # what is not of every stream, such as `buffer`
        return getattr(self._stream, name)

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    @property
    def errors(self) -> str | None:  # type: ignore[override]
        return self._stream.errors

    def _survive(self, error: OSError) -> None:
        """Lets the descriptor lead nowhere, for all who write to it: what still waits in the stream is lost there,
        and not an error again at each flush up to the interpreter's end."""
        if error.errno not in _READER_GONE:
            raise error
        log.info("nobody reads the output any more: %s", error.strerror or error)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)


def make_output_last() -> None:
    """Let standard output and standard error of this process outlive their readers."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, LastingOutput):
            setattr(sys, name, cast("TextIO", LastingOutput(stream)))
