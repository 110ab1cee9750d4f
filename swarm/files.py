"""The one writer of files: whole or not at all, and one sentence and exit code for what the system refuses.

A full disk, a read-only one and missing rights (ENOSPC, EROFS, EACCES) are a `StoreError` that names the file. Work
which takes long tries the folder beforehand (`check_writable`).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from swarm.errors import StoreError

_PROBE_BYTES = 1 << 16
"""A whole block of any usual file system, whose blocks have 64 KiB at most: less may find room on a full disk."""


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns what the system refuses into a StoreError that names the file, and another one that it was about."""
    try:
        yield
    except OSError as error:
        other = isinstance(error.filename, str) and Path(error.filename).parent not in (path, path.parent)
        where = f"{error.filename}: " if other else ""
        raise StoreError(f"cannot write {path}: {where}{error.strerror or error}") from error


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path with the suffix of `path`. When the block ends without an error, the temporary file
    replaces `path` atomically; after an error it is removed, to free the space. A device or pipe is written in
    place. Raises StoreError, which names `path`."""
    partial = path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")
    with writing(path):
        if path.exists() and not (path.is_file() or path.is_dir()):
            yield path
            return
        try:
            partial.unlink(missing_ok=True)
            yield partial
            partial.replace(path)
        except StoreError as error:  # GDAL names the file that it writes
            raise StoreError(str(error).replace(partial.name, path.name)) from error
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def write_file(path: Path, content: bytes) -> None:
    """Replaces a file at one instant, and has it on the disk. Raises StoreError."""
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        if partial.is_file():  # a pipe has no disk
            os.fsync(file.fileno())


def make_folder(folder: Path, mode: int = 0o777) -> None:
    """Makes a folder and its parents, if they are missing. Raises StoreError."""
    with writing(folder):
        folder.mkdir(mode, parents=True, exist_ok=True)


def sync_folder(folder: Path) -> None:
    """Has the names in a folder on the disk: a file that replaced another stays there after a loss of power."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def check_writable(folder: Path, size: int = _PROBE_BYTES, *, file: Path | None = None) -> None:
    """Raises StoreError if a folder takes no file of some bytes: it is written, and removed.

    file  to be written there later, which the error names
    """
    probe = folder / f".space.{os.getpid()}"
    with writing(file or folder):
        try:
            probe.unlink(missing_ok=True)
            with probe.open("xb") as opened:  # follows no link
                opened.write(bytes(size))
        finally:
            with contextlib.suppress(OSError):
                probe.unlink()


def discard_output(*descriptors: int) -> None:
    """Makes descriptors of this process lead nowhere, for all who write to them, native libraries included."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in descriptors:
        os.dup2(nowhere, descriptor)
    os.close(nowhere)
