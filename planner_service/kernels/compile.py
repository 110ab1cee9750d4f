"""`njit` of this folder: numba's, with a disk cache that watches all of the folder's sources.

numba's own cache (`numba.njit(cache=True)`) compares a function's file with what it was when compiled. It does
not see that a helper or a constant of another file has changed, although both are compiled into the function. The
stamp here is a hash of every source of this package, so that kernels can share helpers and constants.
"""

from __future__ import annotations

import contextlib
import hashlib
from importlib import resources

import numba
from numba.core import caching, config


def _stamp() -> tuple[str, bool]:
    """What compiled code depends on, beside what numba's index knows: sources, and whether indices are checked."""
    digest = hashlib.sha256()
    for source in sorted(resources.files(__package__).iterdir(), key=lambda entry: entry.name):
        if source.name.endswith(".py"):
            text = source.read_bytes()
            digest.update(f"{source.name} {len(text)} ".encode() + text)
    return digest.hexdigest(), bool(config.BOUNDSCHECK)


_STAMP = _stamp()


class _FolderCache(caching.FunctionCache):
    """A function's cache on disk, found where numba would put it (NUMBA_CACHE_DIR, __pycache__ or the user's)."""

    def __init__(self, function):
        super().__init__(function)
        self._cache_file = caching.IndexDataCacheFile(self.cache_path, self._impl.filename_base, _STAMP)


def njit(function):
    """Compile a function when it is first called, without the GIL, and keep the result on disk.

    Where no folder can be written to, every process compiles for itself. With NUMBA_DISABLE_JIT the function stays
    as it is.
    """
    compiled = numba.njit(nogil=True)(function)
    if config.DISABLE_JIT:
        return compiled
    with contextlib.suppress(RuntimeError):  # which numba raises where it finds no place for a cache
        compiled._cache = _FolderCache(function)
    return compiled
