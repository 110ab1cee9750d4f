"""The picture of a siege: recovery after each blow, and what the processes took up."""

from __future__ import annotations

from pathlib import Path

from chaos.tally import QUICK_S, Tally
from launch_scripts.observe.palette import STYLE
from swarm.errors import StoreError

_COLOURS = {"calm": "#9aa3ad", "kill": "#c44e52", "hang": "#dd8452", "messages": "#4c72b0"}


def draw(tally: Tally, path: Path) -> None:
    """Writes a PNG. Raises StoreError where it cannot."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 6), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        for kind, colour in _COLOURS.items():
            some = [each for each in tally.outcomes if each.kind == kind and each.recovered_s is not None]
            times, took = [each.at_s for each in some], [each.recovered_s for each in some]
            if some:
                above.scatter(times, took, s=22, color=colour, label=kind)
        never = [each.at_s for each in tally.outcomes if each.recovered_s is None]
        if never:
            above.scatter(never, [tally.within_s] * len(never), marker="x", color="black", label="never")
        above.axhline(QUICK_S, color="#9aa3ad", linewidth=0.8, linestyle="--")
        above.set_title("Seconds until every vehicle is routed and moves")
        above.set_ylim(bottom=0)
        above.legend(loc="upper right", ncols=5)
        if tally.samples:
            first = tally.samples[min(len(tally.samples) // 3, len(tally.samples) - 1)]
            times = [each.at_s for each in tally.samples]
            for what, colour in (("rss_mb", "#4c72b0"), ("threads", "#55a868"), ("files", "#dd8452")):
                base = max(getattr(first, what), 1e-9)
                share = [getattr(each, what) / base for each in tally.samples]
                below.plot(times, share, color=colour, label=what, linewidth=1)
            below.legend(loc="upper right", ncols=3)
        below.set_title("Memory, threads and files of all processes, relative to a third of the run")
        below.set_xlabel("s")
        try:
            figure.savefig(path, dpi=110)
        except OSError as error:
            raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
