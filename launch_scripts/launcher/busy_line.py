"""What a launcher is busy with, and for how long: shown from the first second on."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.live import Live
from rich.text import Text

PATIENCE_S = 1.0
_LINE_EVERY_S = 5.0
_DRAW_EVERY_S = 0.2


def busy_loading(*, as_json: bool, plain: bool) -> contextlib.AbstractContextManager[None]:
    """Says so while the modules of a launcher are loaded, before there is a run whose terminal could."""
    console = Console(stderr=as_json, highlight=False)
    return busy_line(console, console.print, lambda: "loading", changes=console.is_terminal and not plain)


@contextlib.contextmanager
def busy_line(
    console: Console, say: Callable[[str], None], text: Callable[[], str], *, changes: bool
) -> Iterator[None]:
    """Tells on a thread what goes on beside it, as the one at work may be in native code for seconds. What takes
    less than a second is not told of.

    say      prints a line that stays
    text     what goes on, with counts where there are any; the seconds are added here
    changes  whether the terminal can show a line that changes; otherwise a line is said every 5 s
    """
    began_s = time.monotonic()
    over = threading.Event()

    def now() -> str:
        return f"{text()}, {time.monotonic() - began_s:.0f} s"

    def tell() -> None:
        if over.wait(PATIENCE_S):
            return
        if not changes:
            say(f"{now()} ...")
            while not over.wait(_LINE_EVERY_S):
                say(f"{now()} ...")
            return
        with contextlib.suppress(OSError), Live(console=console, auto_refresh=False, transient=True) as live:
            while True:
                live.update(Text(f"{now()} ...", style="dim", overflow="ellipsis", no_wrap=True), refresh=True)
                if over.wait(_DRAW_EVERY_S):
                    return

    thread = threading.Thread(target=tell, name="busy-line", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(1.0)
