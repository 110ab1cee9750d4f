"""What others say in words does nothing in the view but stand there, and does not fill it."""

from __future__ import annotations

import msgspec
import pytest
from support.monitor_rig import Rig, little_scenario, little_terrain

from launch_scripts.monitor.sinks import in_markdown, shown
from swarm.wire.messages.planning import PlannerStatus


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("behind: agent-a0", "behind: agent-a0"),
        ("a\n# b\x1b[31m", "a # b?[31m"),
        ("gate \U0001f600 \u6f22", "gate ? ?"),
        ("x" * 400, "x" * 297 + "..."),
    ],
)
def test_a_strange_text_is_one_line_of_characters_that_every_viewer_has(text: str, line: str) -> None:
    assert shown(text) == line


def test_markdown_of_others_is_shown_and_not_read() -> None:
    assert in_markdown("![x](http://a/) | **b**") == r"\!\[x\](http://a/) \| \*\*b\*\*"


def test_names_that_planners_make_up_do_not_fill_the_view() -> None:
    rig = Rig(little_scenario(), little_terrain(), None)
    told = PlannerStatus(
        target="t0", incarnation=1, stamp_ns=1, strategy="", target_cell=None, map_version=0, tree_age_ms=0,
        window=[], growths=0, window_growths=0, growth_ms=0, routes_served=0, following=0,
    )  # fmt: skip
    for n in range(300):
        rig.service._ground.hear_status(msgspec.structs.replace(told, target=f"x{n}"))
    assert len(rig.service._ground.samples.targets) == 258
    rig.sinks.close()
