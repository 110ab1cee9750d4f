"""NumPy, imported when it is first used: a robot's process neither waits for it nor needs it installed.

All roles of a swarm load it. Where nothing has, `numpy_loaded` is false and messages are read as lists, which is
slower for many values and needs nothing: so does `swarm.client`.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from swarm.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
else:

    class _NumPy:
        """Stands for the module until a name of it is looked up, and keeps each name that was."""

        def __getattr__(self, name: str) -> Any:
            if name.startswith("__"):
                raise AttributeError(name)
            try:
                import numpy
            except ModuleNotFoundError as error:
                raise ConfigError("this needs NumPy: pip install 'terrain-swarm[all]'") from error
            value = getattr(numpy, name)
            setattr(self, name, value)
            return value

    np = _NumPy()

__all__ = ["np", "numpy_loaded"]


def numpy_loaded() -> bool:
    """Whether anything in this process has imported NumPy: if not, bytes are read as lists."""
    return sys.modules.get("numpy") is not None
