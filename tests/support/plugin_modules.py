"""Modules of plug-ins that tests write, and forget again."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def forgotten_afterwards(folder: Path) -> Iterator[None]:
    """Leaves no module of this folder behind, nor the folder on the path."""
    path = list(sys.path)
    try:
        yield
    finally:
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None)).startswith(str(folder)):
                del sys.modules[name]
        sys.path[:] = path
        importlib.invalidate_caches()
