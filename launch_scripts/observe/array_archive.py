"""Archives of arrays that a run leaves: read whole, or refused in one sentence."""

from __future__ import annotations

import contextlib
import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm.errors import StoreError

_DAMAGES = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, NotImplementedError, SyntaxError),
    *(MemoryError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
"""What NumPy and zipfile raise on bytes that are no archive of arrays."""
_MOST_BYTES = 1 << 30
"""Of all arrays, unpacked."""


def packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The content of the file."""
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


@contextlib.contextmanager
def arrays_in(content: bytes, path: Path) -> Iterator[Any]:
    """The arrays of a file, by name. Raises StoreError if it is damaged, which it is, too, if whoever reads them
    raises what they are wrong by, as ValueError; `path` is how the sentence calls the file."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            unpacked = sum(each.file_size for each in archive.infolist())
        if unpacked > _MOST_BYTES:
            raise ValueError(f"{unpacked} bytes when unpacked, at most {_MOST_BYTES}")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            yield arrays
    except _DAMAGES as error:
        raise StoreError(f"{path} is damaged: {error}") from error
