"""Progress bars for whatever takes longer than a second."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from shared_map.terrain.row_bands import Progress as Tell

_PATIENCE_S = 1.0


@contextlib.contextmanager
def progress() -> Iterator[Tell]:
    """Yields what draws one bar per kind of work, on a terminal only and after the first second."""
    started_s = time.monotonic()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as shown:
        tasks: dict[str, TaskID] = {}

        def tell(what: str, share: float) -> None:
            if what not in tasks:
                if time.monotonic() - started_s < _PATIENCE_S:
                    return
                tasks[what] = shown.add_task(what, total=1.0)
            shown.update(tasks[what], completed=share)

        yield tell
