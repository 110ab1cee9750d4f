"""The lock of the wire: what may change under the same version does, all else is refused with a sentence."""

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support import wire_lock
from support.wire_lock import broken, lock

from swarm.wire.messages import WIRE_VERSION

Change = Callable[[Any], object]


def fields(now: Any, name: str = "fleet", struct: str = "Fleet") -> list[str]:
    return now["messages"][name]["structs"][struct]


def stepped(
    now: Any, name: str = "fleet", *, reads: tuple[int, ...] = (8, 9), writes: int = 8, wire: int = WIRE_VERSION + 1
) -> None:
    """A message takes a step, with another type of a field."""
    fields(now, name, {"fleet": "Fleet", "run": "RunInfo"}[name])[0] += ", text"
    now["messages"][name] |= {"reads": list(reads), "writes": writes}
    now["wire_version"] = wire


ALLOWED: dict[str, Change] = {
    "nothing": lambda now: None,
    "a field is added": lambda now: fields(now).append("colour | id | None"),
    "a field of a part is added": lambda now: fields(now, "host-state", "Stand").append("colour | id | None"),
    "a message and its key are added": lambda now: (
        now["messages"].update(new=copy.deepcopy(now["messages"]["fleet"])),
        now["keys"].update(new=copy.deepcopy(now["keys"]["fleet"])),
    ),
    "the wire version rises": lambda now: now.update(wire_version=WIRE_VERSION + 1),
    "a message takes a step": stepped,
    "a key changes with the wire version": lambda now: (
        now.update(wire_version=WIRE_VERSION + 1),
        now["keys"].update(fleet="fleets/{author}"),
    ),
}  # fmt: skip

REFUSED: dict[str, tuple[Change, str]] = {
    "a field goes": (lambda now: fields(now).pop(), "Fleet.vehicle_class was .* and is gone: fleet needs a step"),
    "bounds change": (
        lambda now: fields(now).__setitem__(3, "seq | int(0..7) | required"),
        r"Fleet.seq was seq \| int\(0..2\^62-1\) \| required and is seq \| int\(0..7\) \| required: fleet needs",
    ),
    "a default changes": (
        lambda now: fields(now).__setitem__(-1, "vehicle_class | id | 'air'"), "Fleet.vehicle_class was",
    ),
    "a field is put in between": (lambda now: fields(now).insert(1, "x | id | None"), "Fleet.group was"),
    "an added field has no default": (
        lambda now: fields(now).append("colour | id | required"), "Fleet.colour is added without a default",
    ),
    "a key changes": (
        lambda now: now["keys"].update(fleet="fleets/{author}"), "topic fleet has changed: the wire version",
    ),
    "a message goes": (lambda now: now["messages"].pop("fleet"), "the message fleet is gone"),
    "the wire version skips one": (lambda now: now.update(wire_version=WIRE_VERSION + 2), "it rises by one"),
    "a token's key changes": (lambda now: now.update(token="here/{id}"), "it never changes"),
    "a step without the wire version": (lambda now: stepped(now, wire=WIRE_VERSION), "the wire version has"),
    "a step that is written at once": (
        lambda now: stepped(now, writes=9), "fleet is written in version 9, which the build before does not read",
    ),
    "a step that forgets the version before": (
        lambda now: stepped(now, reads=(9,)), "fleet of version 8, which the build before writes, is no longer",
    ),
    "a part is written in another way": (
        lambda now: now["messages"]["host-state"]["layouts"].update(Stand="map"),
        'Stand was "list" and is "map": host-state',
    ),
    "what is added later is refused from now on": (
        lambda now: now["messages"]["fleet"]["layouts"].update(Fleet="map, no other fields"), "Fleet was",
    ),
    "an enumeration gets one more value": (
        lambda now: now["messages"]["pushed-route"]["values"]["RouteStatus"].append("lost"),
        r"RouteStatus was .*: pushed-route needs",
    ),
    "what introduces a build takes a step": (lambda now: stepped(now, "run"), "run has taken a step: it never"),
}  # fmt: skip


def sentences(change: Change) -> list[str]:
    now = copy.deepcopy(lock())
    change(now)
    return list(broken(lock(), now))


@pytest.mark.parametrize("change", ALLOWED)
def test_what_neighbours_understand_is_allowed(change: str) -> None:
    assert sentences(ALLOWED[change]) == []


@pytest.mark.parametrize("change", REFUSED)
def test_what_they_would_not_is_refused_with_a_sentence(change: str) -> None:
    changed, words = REFUSED[change]
    assert any(re.search(words, sentence) for sentence in sentences(changed)), sentences(changed)


def test_the_lock_is_that_of_this_build_and_a_change_that_breaks_a_rule_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    said = wire_lock.PATH.read_text(encoding="utf-8")
    assert said == wire_lock.document(), "run `python -m support.wire_lock`"
    monkeypatch.setattr(wire_lock, "PATH", tmp_path / "wire.lock")
    wire_lock.PATH.write_text(said.replace('"author | ', '"writer | ', 1))
    assert any("needs a step to its next version" in fault for fault in wire_lock.faults())
