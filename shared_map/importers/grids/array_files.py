"""Readers of numpy's files. What a header promises is checked against the file's length before memory is taken."""

from __future__ import annotations

import ast
import io
import lzma
import math
import os
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from swarm.config.input_files import FileKind, check_bytes, size
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS

_KEYS = {"descr", "fortran_order", "shape"}
_HEADER_BYTES = 4096
_CHUNK_BYTES = 1 << 20
_PACKED_FAULTS = (
    ValueError, zipfile.BadZipFile, EOFError, KeyError, RuntimeError, zlib.error, lzma.LZMAError, OverflowError,
)  # fmt: skip
"""What zipfile and its unpackers raise on damaged, encrypted or unknown members."""


def read_npy(path: Path, kind: FileKind) -> NDArray[Any]:
    """The numbers of a .npy file. Raises TerrainError."""
    length = check_bytes(path, kind)
    try:
        with path.open("rb") as file:
            return _read_array(file, length)
    except OSError as error:
        raise kind.unreadable(path, error) from error
    except ValueError as error:
        raise TerrainError(f"{kind.what} {path} is no .npy array: {error}") from error


def read_members(path: Path, names: tuple[str, ...]) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """(arrays, shapes) of an .npz file: the members of these names, and what shape every member says it has.

    Others are never unpacked. Together the named ones may be as large as the file may be. Raises TerrainError.
    """
    kind = FileKind.ARRAYS
    check_bytes(path, kind)
    try:
        with _ShortReads(path) as file, zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            wanted = {name: members[name] for name in names if name in members}
            total = sum(info.file_size for info in wanted.values())
            if total > kind.most_bytes:
                raise kind.refusal(
                    path, f"its arrays would unpack to {size(total)}; at most {size(kind.most_bytes)} are read"
                )
            arrays: dict[str, NDArray[Any]] = {}
            shapes: dict[str, str] = {}
            for name, info in list(members.items())[:10]:
                with archive.open(info) as member:
                    shapes[name] = _shape_of(member)
            for name, info in wanted.items():
                with archive.open(info) as member:
                    arrays[name] = _read_array(member, info.file_size)
                    member.read(1)  # at its end the checksum is compared
            return arrays, shapes
    except OSError as error:
        raise kind.unreadable(path, error) from error
    except _PACKED_FAULTS as error:
        raise TerrainError(f"terrain {path} is truncated or no .npz of numbers: {error}") from error


class _ShortReads(io.FileIO):
    """A file of which nobody reads much at once, so that an archive's table of contents is bounded, too."""

    def read(self, count: int | None = -1) -> bytes:
        if count is None or count < 0:
            count = os.fstat(self.fileno()).st_size - self.tell()
        if count > _CHUNK_BYTES:
            raise zipfile.BadZipFile(f"its table of contents has {size(count)}")
        return super().read(count) or b""


def _shape_of(member: IO[bytes]) -> str:
    try:
        return str(_header(member)[0])
    except _PACKED_FAULTS:
        return "of no numbers"


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any], bool, int]:
    """(shape, type, in Fortran's order, bytes of the header). Raises ValueError."""
    magic = file.read(8)
    if magic[:6] != b"\x93NUMPY" or len(magic) < 8 or magic[6] not in (1, 2, 3):
        raise ValueError("it does not begin as an array of numpy")
    width = 2 if magic[6] == 1 else 4
    length = int.from_bytes(file.read(width), "little")
    if length > _HEADER_BYTES:
        raise ValueError(f"its header has {length} bytes; at most {_HEADER_BYTES} are read")
    text = file.read(length)
    try:
        found = ast.literal_eval(text.decode("latin1").strip())
        if not isinstance(found, dict) or set(found) != _KEYS:
            raise ValueError
        shape, fortran = found["shape"], found["fortran_order"]
        dtype = np.dtype(found["descr"]) if isinstance(found["descr"], str) else None
        fits = isinstance(shape, tuple) and len(shape) < 8 and all(type(n) is int and n >= 0 for n in shape)
        if not fits or type(fortran) is not bool:
            raise ValueError
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise ValueError("its header is none of numpy's") from error
    if dtype is None or dtype.kind not in "iufb" or dtype.itemsize > 8:
        raise ValueError(f"it holds {str(found['descr'])[:40]!r}; expected numbers of at most 8 bytes")
    return shape, dtype, fortran, 8 + width + length


def _read_array(file: IO[bytes], length: int) -> NDArray[Any]:
    """An array from a file that is `length` bytes long. Raises ValueError."""
    shape, dtype, fortran, head = _header(file)
    cells = math.prod(shape)
    if cells > 3 * MAX_CELLS:
        raise ValueError(f"its header says {' x '.join(map(str, shape))}; at most {MAX_CELLS} cells are read")
    if head + cells * dtype.itemsize != length:
        promised, has = size(cells * dtype.itemsize), size(max(length - head, 0))
        raise ValueError(f"its header promises {promised} of numbers, and it has {has}")
    flat = np.empty(cells, dtype)
    into = flat.view(np.uint8).data if cells else memoryview(b"")
    at = 0
    while at < len(into):
        part = file.read(min(_CHUNK_BYTES, len(into) - at))
        if not part:
            raise ValueError(f"it ends after {size(head + at)} of {size(length)}")
        into[at : at + len(part)] = part
        at += len(part)
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
