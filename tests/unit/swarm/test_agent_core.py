"""An agent whose file takes nothing is no member: it promises, stores and tells nothing until its file takes it."""

from unittest.mock import MagicMock

import msgspec
from support.shard_tables import AGENTS, MEMBERS, S, rights_of, table_of

from swarm.bus.bus import Replied
from swarm.config.scenario import Scenario
from swarm.grid import GridSpec
from swarm.right_of_way.agent_core import Action, OwnRecord, RightOfWay
from swarm.right_of_way.agent_on_bus import RightOfWaySync
from swarm.right_of_way.holdings import SendState
from swarm.right_of_way.host import AskKnown
from swarm.right_of_way.promise_store import PromiseStore
from swarm.right_of_way.shard_member import AskPromises, Save
from swarm.right_of_way.shards import Shards
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.traffic import Fence, Held, Known, KnownRequest, Table
from swarm.wire.topics import KNOWN

THREE = ["a0", "a1", "a2"]
SHARDS_OF_THREE = Shards(GridSpec(8, 8, 1.0), THREE)
SPAWNS = {agent: {f"{agent}-00": 9 * n} for n, agent in enumerate(THREE)}


def member() -> RightOfWay:
    own = OwnRecord(disk=1, generations=[1], noted_by=[agent for agent in THREE if agent != "a0"])
    return RightOfWay("a0", SHARDS_OF_THREE, SPAWNS, own, {})


def test_a_silent_member_says_nothing_and_remembers_nothing_that_is_not_on_file() -> None:
    rights = member()
    rights.silent = True
    epoch = next(n for n in range(1, 9) if SHARDS_OF_THREE.leader(0, n) == "a1")
    table = Table(shard=0, agent="a1", epoch=epoch, seq=1, hosts={}, grants={})
    assert rights.hear_claim(0, epoch, 5 * S) == []
    assert rights.hear_table(table, 5 * S) == []
    assert rights.answer_known(KnownRequest(agent="a1", disk=7)) == []
    assert rights.hear_known(Known(agent="a1", disk=1, generation=0, shards=[])) == []
    assert rights.tick({}, 9 * S) == []
    assert rights.own == member().own
    rights.silent = False
    promise = rights.hear_claim(0, epoch, 5 * S)
    assert promise[0].promised == epoch, "nothing was promised meanwhile"
    assert len(rights.answer_known(KnownRequest(agent="a1", disk=7))) == 2


def test_a_silent_leader_sends_no_table_and_its_host_still_tells_where_its_vehicles_stand() -> None:
    rights = member()
    rights.begin(1)
    rights.host.watch([0])
    said = _through(rights, range(1, 40))
    assert any(isinstance(action, Save | AskPromises) for action in said)
    rights.silent = True
    said = _through(rights, range(40, 80))
    assert not any(isinstance(action, Table | Save | AskPromises) for action in said)
    assert any(isinstance(action, SendState) for action in said), "its host goes on"


def _through(rights: RightOfWay, ticks: range) -> list[Action]:
    """All messages of some ticks; the host's own messages are heard by its own seat."""
    said: list[Action] = []
    for tick in ticks:
        for action in rights.tick({}, tick * S // 10):
            said.append(action)
            if isinstance(action, SendState):
                rights.hear_host_state(action.state, tick * S // 10)
    return said


def test_a_replaced_generation_finds_the_shards_that_keep_its_cells_shut_and_says_there_that_it_has_stopped():
    """No other process can: the later incarnation has another file. It had left that shard long ago."""
    table = msgspec.structs.replace(table_of(1, 1), fences=[Fence("a4", 1 << 32, {"a4-00": Held.of([(9, 1, 1)])})])
    member = rights_of(MEMBERS[0], {0: (1, table)})
    (*_, known) = member.answer_known(KnownRequest(agent="a4", disk=7))
    assert known.shards == [0]
    older = rights_of("a4")
    older.begin(0)
    for name in AGENTS[:4]:
        older.hear_known(Known(agent=name, disk=7, generation=0, shards=[]))
    assert older.settled
    older.host.watched.clear()
    older.host.replaced = True
    assert not older.settled  # the question about it is repeated
    older.hear_known(known)
    (told,) = older.tick({}, S)
    assert (told.state.shard, told.state.ended) == (0, True)


def test_late_answers_count_for_the_generation_that_asked_only() -> None:
    """Answers to an earlier question are older than the shards into which that one's successor drove."""
    rights, bus = rights_of("a0"), MagicMock()
    setup = RoleSetup(Scenario(), "run", "agent", "a0", 1, 1)
    sync = RightOfWaySync(rights, setup, PromiseStore(7), bus, MagicMock(), MagicMock())
    sync.start(0)
    sync.tick({}, S)  # it begins without answers
    sync._perform([AskKnown()])
    sync.tick({}, 2 * S)
    for tag in dict.fromkeys(call.kwargs["tag"] for call in bus.ask.call_args_list):
        assert not rights.host.informed
        for agent in AGENTS[1:]:
            known = Known(agent=agent, disk=7, generation=0, shards=[])
            sync.on_cells_event(Replied(tag, KNOWN, {"agent": agent}, known), 3 * S)
    assert rights.host.informed
