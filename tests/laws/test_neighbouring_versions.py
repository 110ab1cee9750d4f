"""No message is unreadable for a live member of a run of two neighbouring versions, in whatever order all are
started again (docs/design/wire-format.md)."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.effort import few
from support.neighbour import ROOT, environment_of, neighbour_tree
from support.wire_specimens import KINDS, lines, read

import swarm.wire.versions as versions
from swarm.errors import ProtocolError
from swarm.wire.codec import decode, encode
from swarm.wire.messages import WIRE_VERSION, Message, Nothing, schema_of
from swarm.wire.messages.processes import RunInfo
from swarm.wire.versions import STEPS, Step, are_neighbours, schema_of_type

SPECIMENS = ROOT / "tests" / "specimens"


# --- a model of a message's history -------------------------------------------------------------------------------


def kept(fields: dict[str, Any]) -> dict[str, Any]:
    return fields


class Build:
    """The treatment of a message by a build of a wire version whose steps began in the wire versions `begun_in`, by
    the rules of `Step` alone."""

    def __init__(self, wire: int, begun_in: list[int]) -> None:
        self.wire = wire
        past = [each for each in begun_in if each <= wire]
        self.newest = len(past)
        self._step = Step(past[-1], kept, kept) if past else None

    @property
    def writes(self) -> int:
        return self.newest - (self._step is not None and self._step.writes_older(self.wire))

    @property
    def reads(self) -> set[int]:
        older = self._step is not None and self._step.reads_older(self.wire)
        return {self.newest, self.newest - older}


@st.composite
def histories(draw: st.DrawFn) -> tuple[list[int], list[tuple[int, int]]]:
    """In which wire versions a message took steps, two apart at least; and which member was started again with the
    build of which wire version."""
    gaps = draw(st.lists(st.integers(2, 4), max_size=4))
    begun_in = [sum(gaps[: index + 1]) for index in range(len(gaps))]
    restarts = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 16)), max_size=40)
    return begun_in, draw(restarts)


@settings(max_examples=few(500), deadline=None)
@given(histories())
@example(([2, 4], [(n, wire) for wire in range(1, 7) for n in range(4)]))
@example(([2], [(0, 1), (0, 0), (1, 1), (0, 1), (2, 1), (3, 1), (1, 2), (1, 1)]))
def test_no_message_is_unreadable_for_a_live_member_in_any_order_of_restarts(
    history: tuple[list[int], list[tuple[int, int]]],
) -> None:
    begun_in, restarts = history
    members = [Build(0, begun_in)] * 4
    under_way = {members[0].writes}
    """Versions of messages since the restart before the last one: they may still be in transit."""
    for which, wire in restarts:
        others = members[:which] + members[which + 1 :]
        if not all(are_neighbours(wire, other.wire) for other in others):
            continue  # membership refuses it
        members[which] = Build(wire, begun_in)
        now = {member.writes for member in members}
        for member in members:
            assert under_way | now <= member.reads
        under_way = now


@pytest.mark.parametrize("wrong", ["writes_at_once", "forgets_at_once"])
def test_the_model_finds_a_step_that_breaks_the_rules(monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    if wrong == "writes_at_once":
        monkeypatch.setattr(Step, "writes_older", lambda self, wire: wire < self.begun_in)
    else:
        monkeypatch.setattr(Step, "reads_older", lambda self, wire: self.writes_older(wire))
    with pytest.raises(AssertionError):
        test_no_message_is_unreadable_for_a_live_member_in_any_order_of_restarts()


# --- the codec, with a message that takes a step ------------------------------------------------------------------


class SpeedInKnots(Message, frozen=True, kw_only=True, tag=schema_of("speed", 8)):
    id: str
    speed_kn: float


class SpeedInMetres(Message, frozen=True, kw_only=True, tag=schema_of("speed", 9)):
    id: str
    speed_m_per_s: float


STEP = Step(
    begun_in=9,
    raised=lambda fields: {"id": fields["id"], "speed_m_per_s": fields["speed_kn"] * 0.5},
    lowered=lambda fields: {"id": fields["id"], "speed_kn": fields["speed_m_per_s"] / 0.5},
)
BUILDS: dict[int, tuple[type[Message], dict[type[Message], Step]]] = {
    8: (SpeedInKnots, {}),
    9: (SpeedInMetres, {SpeedInMetres: STEP}),
    10: (SpeedInMetres, {SpeedInMetres: STEP}),
    11: (SpeedInMetres, {}),
}


def speak(monkeypatch: pytest.MonkeyPatch, wire: int) -> type[Message]:
    """Makes the codec that of a build of a wire version. Returns its type of the message."""
    kind, steps = BUILDS[wire]
    monkeypatch.setattr(versions, "WIRE_VERSION", wire)
    STEPS.clear()
    STEPS.update(steps)
    return kind


@pytest.fixture
def no_steps() -> Any:
    before = dict(STEPS)
    yield
    STEPS.clear()
    STEPS.update(before)


@pytest.mark.usefixtures("no_steps")
@pytest.mark.parametrize("writer", BUILDS)
@pytest.mark.parametrize("reader", BUILDS)
def test_what_a_build_writes_its_neighbours_read_as_their_own_and_others_refuse_in_a_sentence(
    monkeypatch: pytest.MonkeyPatch, writer: int, reader: int
) -> None:
    kind = speak(monkeypatch, writer)
    payload = encode(kind(**{"id": "a", kind.__struct_fields__[1]: 6.0 if kind is SpeedInKnots else 3.0}))
    own = speak(monkeypatch, reader)
    if are_neighbours(writer, reader):
        message = decode(payload, own)
        assert message == own(**{"id": "a", own.__struct_fields__[1]: 6.0 if own is SpeedInKnots else 3.0})
    elif (writer, reader) in ((8, 11), (10, 8), (11, 8)):
        versions_of = (8, 9) if writer == 8 else (9, 8)
        words = "speed is of version {}, but this build, of wire version {}, reads {}$"
        with pytest.raises(ProtocolError, match=words.format(versions_of[0], reader, versions_of[1])):
            decode(payload, own)


@pytest.mark.usefixtures("no_steps")
@pytest.mark.parametrize("fields", [{}, {"speed_kn": "fast", "id": "a"}, {"speed_kn": None}, {1: 2}])
def test_a_converter_that_meets_nonsense_refuses_it(
    monkeypatch: pytest.MonkeyPatch, fields: dict[Any, Any]
) -> None:
    import msgpack

    kind = speak(monkeypatch, 9)
    with pytest.raises(ProtocolError, match="speed/8 cannot be read as speed/9"):
        decode(msgpack.packb({"schema": "speed/8"} | fields), kind)


def test_no_step_outlives_its_neighbours_and_what_introduces_a_build_never_takes_one() -> None:
    assert [kind for kind, step in STEPS.items() if not step.reads_older(WIRE_VERSION)] == []
    assert schema_of_type(RunInfo) == "run/8"
    assert schema_of_type(Nothing) == "nothing/8"
    assert not {RunInfo, Nothing} & set(STEPS)


# --- the version before -------------------------------------------------------------------------------------------


def test_every_message_that_the_version_before_has_written_is_read_as_it_was_meant() -> None:
    paths = [path for path in SPECIMENS.glob("wire-*.txt") if are_neighbours(int(path.stem[5:]), WIRE_VERSION)]
    if not paths:
        pytest.skip("no build of another version shares a run with this one")
    specimens = [line for path in paths for line in path.read_text().splitlines()]
    assert {line.split()[0] for line in specimens} <= set(KINDS)
    assert len(specimens) > 100
    for line in specimens:
        answer = read(line)
        assert not answer.startswith("error"), f"{line}: {answer}"
        check_same(line, answer)


def test_the_version_before_reads_every_message_of_this_one(tmp_path: Path) -> None:
    tree = neighbour_tree(tmp_path)
    said = lines(few(50))
    answered = called(tree, "wire_specimens.py", "read", input="\n".join(said))
    answers = answered.stdout.splitlines()
    assert len(answers) == len(said), answered.stderr
    heard = [pair for pair in zip(said, answers, strict=True) if pair[1] != "unknown"]
    assert len(heard) > 100
    for line, answer in heard:
        assert not answer.startswith("error"), f"{line}: {answer}"
        check_same(line, answer)


def test_files_of_the_version_before_are_read_and_it_refuses_ours_in_a_sentence(tmp_path: Path) -> None:
    old = neighbour_tree(tmp_path)

    def stored(what: str, tree: Path, folder: str) -> subprocess.CompletedProcess[str]:
        (tmp_path / folder).mkdir(exist_ok=True)
        return called(tree, "stored_by.py", what, str(tmp_path / folder))

    stored("write", old, "older")
    found = [stored("read", tree, "older").stdout for tree in (old, ROOT)]
    left, again = ([json.loads(line) for line in each.splitlines()] for each in found)
    assert len(left) == len(again) >= 6
    for meant, heard in zip(left, again, strict=True):
        both = meant.keys() & heard.keys()
        assert len(both) >= 2
        assert {name: heard[name] for name in both} == {name: meant[name] for name in both}
    stored("write", ROOT, "newer")
    assert "StoreError: cannot open the store" in stored("read", old, "newer").stderr


def called(tree: Path, script: str, *words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """A script of `tests/support` that has run on the packages of a tree."""
    command = [sys.executable, str(ROOT / "tests" / "support" / script), *words]
    return subprocess.run(
        command, env=environment_of(tree), capture_output=True, text=True, timeout=120, check=False, **options
    )


def check_same(line: str, answer: str) -> None:
    """All fields that the answering build knows have the value that was sent, wherever both have them."""
    name, payload = line.split()
    fields, again = answer.split()
    sent, heard = (decode(bytes.fromhex(each), KINDS[name]) for each in (payload, again))
    for field in fields.split(","):
        if field in sent.__struct_fields__:
            assert encode_field(sent, field) == encode_field(heard, field), f"{name}.{field}"


def encode_field(message: Message, field: str) -> object:
    value = getattr(message, field)
    return value.listed if hasattr(value, "listed") else value
