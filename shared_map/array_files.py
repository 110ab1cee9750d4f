"""Short names of array types for signatures; arrays in files which all processes of a machine share, and the digest
of the code that made them."""

from __future__ import annotations

import ctypes
import functools
import hashlib
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from swarm.files import replacing

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Options of mallopt(3)."""


class _Mapped(np.memmap[Any, Any]):
    """A mapped file that stays open, so that it can be mapped again after its name has gone to another."""

    file: Any = None

    def __array_finalize__(self, obj: Any) -> None:
        super().__array_finalize__(obj)
        self.file = getattr(obj, "file", None)


def open_array(path: Path) -> NDArray[Any]:
    """The array of a .npy file, mapped read-only: its pages are in memory once, however many processes read them.

    Raises OSError or ValueError where the file is not there or damaged; never runs code of it.
    """
    file = path.open("rb")
    major, _ = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    try:
        shape, in_columns, dtype = read(file)
    except (SyntaxError, TokenError) as error:
        raise ValueError(f"header of an array: {error}") from error
    if dtype.hasobject or in_columns:
        raise ValueError(f"array of {dtype}" if dtype.hasobject else "array in columns")
    return np.asarray(_map(file, dtype, shape, file.tell(), "r"))


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Writes an array where `open_array` reads it, at once: other processes see all of it or nothing. Raises
    StoreError."""
    with replacing(path) as partial, partial.open("wb") as file:
        np.save(file, np.ascontiguousarray(array), allow_pickle=False)


def private_copy(array: NDArray[Any]) -> NDArray[Any]:
    """A copy that may be written to. Of an array from `open_array` only the pages (4 KiB each) that are written to
    are copied, at the first write; the file stays as it is."""
    mapped = array.base
    while type(mapped) is np.ndarray:
        mapped = mapped.base
    if not isinstance(mapped, _Mapped) or mapped.__array_interface__ != array.__array_interface__:
        return np.array(array)
    return np.asarray(_map(mapped.file, mapped.dtype, mapped.shape, mapped.offset, "c"))


@functools.cache
def reuse_memory() -> None:
    """Keeps the memory of small freed arrays for the next ones. By default the allocator gives much of it back
    after each band; fetching it again took a fifth of the time of classifying a photo. Large ones are given
    back."""
    set_malloc_option = getattr(ctypes.CDLL(None), "mallopt", None)  # glibc's
    if set_malloc_option is not None:
        set_malloc_option(_TRIM_THRESHOLD, 64 << 20)
        set_malloc_option(_MMAP_THRESHOLD, 16 << 20)


def give_back_memory() -> None:
    """Returns to the system what the allocator keeps of freed arrays; it keeps much where threads made them."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's
    if trim is not None:
        trim(0)


def _map(file: Any, dtype: Any, shape: tuple[int, ...], offset: int, mode: Literal["r", "c"]) -> _Mapped:
    mapped = _Mapped(file, dtype, mode, offset, shape)
    mapped.file = file
    return mapped


class CellsOf:
    """The cells of a mask, numbered in rows, without an array of them: that would take eight bytes a cell."""

    def __init__(self, mask: Bools) -> None:
        self.mask = mask
        self._ends = np.cumsum(np.count_nonzero(mask, axis=1))  # how many there are up to the end of each row

    def __len__(self) -> int:
        return int(self._ends[-1])

    def cell(self, number: int) -> int:
        """The flat index of a cell; `number` is 0 to len - 1."""
        row = int(np.searchsorted(self._ends, number, "right"))
        before = int(self._ends[row - 1]) if row else 0
        return row * int(self.mask.shape[1]) + int(np.flatnonzero(self.mask[row])[number - before])


@functools.cache
def source_digest(*folders: Path) -> str:
    """Returns 16 hex digits of all Python files in these folders, and of the version of NumPy: files kept between
    runs are keyed by the code that made them."""
    digest = hashlib.blake2b(np.__version__.encode(), digest_size=8)
    for folder in folders:
        for path in sorted(folder.glob("*.py")):
            digest.update(f"\0{path.name}\0".encode() + path.read_bytes())
    return digest.hexdigest()
