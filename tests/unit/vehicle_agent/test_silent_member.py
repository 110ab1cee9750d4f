"""An agent whose file takes nothing is no member: it promises, stores and tells nothing until its file takes it."""

from __future__ import annotations

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.right_of_way.holdings import Tell
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.messages.traffic import Known, KnownRequest, Table
from vehicle_agent.traffic.member import AskPromises, Save
from vehicle_agent.traffic.right_of_way_core import Action, OwnRecord, RightOfWay

AGENTS = ["a0", "a1", "a2"]
PLOTS = Plots(GridSpec(8, 8, 1.0), AGENTS)
SPAWNS = {agent: {f"{agent}-00": 9 * n} for n, agent in enumerate(AGENTS)}
S = NS_PER_S


def member() -> RightOfWay:
    own = OwnRecord(disk=1, lives=[1], noted_by=[agent for agent in AGENTS if agent != "a0"])
    return RightOfWay("a0", PLOTS, SPAWNS, own, {})


def test_a_silent_member_says_nothing_and_remembers_nothing_that_is_not_on_file() -> None:
    rights = member()
    rights.silent = True
    epoch = next(n for n in range(1, 9) if PLOTS.warden(0, n) == "a1")
    table = Table(plot=0, agent="a1", epoch=epoch, seq=1, hosts={}, grants={})
    assert rights.hear_claim(0, epoch, 5 * S) == []
    assert rights.hear_table(table, 5 * S) == []
    assert rights.answer_known(KnownRequest(agent="a1", disk=7)) == []
    assert rights.hear_known(Known(agent="a1", disk=1, life=0, plots=[])) == []
    assert rights.tick({}, 9 * S) == []
    assert rights.own == member().own
    rights.silent = False
    promise = rights.hear_claim(0, epoch, 5 * S)
    assert isinstance(promise[0], Save)
    assert promise[0].promised == epoch, "nothing was promised meanwhile"
    assert len(rights.answer_known(KnownRequest(agent="a1", disk=7))) == 2


def test_a_silent_warden_sends_no_table_and_its_host_still_tells_where_its_vehicles_stand() -> None:
    rights = member()
    rights.begin(1)
    rights.holdings.watch([0])
    said = _through(rights, range(1, 40))
    assert any(isinstance(action, Save | AskPromises) for action in said)
    rights.silent = True
    said = _through(rights, range(40, 80))
    assert not any(isinstance(action, Table | Save | AskPromises) for action in said)
    assert any(isinstance(action, Tell) for action in said), "its host goes on"


def _through(rights: RightOfWay, ticks: range) -> list[Action]:
    """All that is said in some ticks; what the host says is heard by its own seat."""
    said: list[Action] = []
    for tick in ticks:
        for action in rights.tick({}, tick * S // 10):
            said.append(action)
            if isinstance(action, Tell):
                rights.hear_standing(action.standing, tick * S // 10)
    return said
