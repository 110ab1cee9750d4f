"""A deployment plan: every process runs once, standbys and keepers apart, and machines carry what they may."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import msgspec
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few

from launch_scripts.deploy.machine_plan import HOST_ROLES, HostConfig, HostsConfig, Plan, cores_of, make_plan
from launch_scripts.launcher.run_options import UpOptions, chosen_processes
from launch_scripts.process_table import LAUNCHER, processes_of
from swarm.bus.zenoh_config import access_control
from swarm.config.scenario import (
    GroupConfig,
    PlannerConfig,
    Scenario,
    StandbyConfig,
    TargetConfig,
    VehicleConfig,
    plan_agents,
)
from swarm.errors import ConfigError

SCENARIOS = st.builds(
    lambda targets, groups, per_agent, planners, movers: Scenario(
        targets=(TargetConfig(count=targets),),
        groups=tuple(GroupConfig(name=f"g{n}", vehicles=vehicles) for n, vehicles in enumerate(groups)),
        vehicles=VehicleConfig(per_agent=per_agent),
        standbys=StandbyConfig(planner=planners, targets=movers),
        planner=PlannerConfig(places=movers > 0),
    ),
    st.integers(1, 12),
    st.lists(st.integers(1, 120), min_size=1, max_size=3),
    st.integers(5, 40),
    st.integers(0, 2),
    st.integers(0, 2),
)
ROLES = st.one_of(st.just(HOST_ROLES), st.lists(st.sampled_from(HOST_ROLES), min_size=1, unique=True).map(tuple))


@st.composite
def machines(draw: st.DrawFn, roles: st.SearchStrategy[tuple[str, ...]] = ROLES) -> HostsConfig:
    count = draw(st.integers(1, 7))
    hosts = tuple(
        HostConfig(
            name=f"m{n}", address=f"10.0.0.{n + 1}", cores=draw(st.sampled_from((0.5, 1, 4, 32))), roles=draw(roles)
        )
        for n in range(count)
    )
    return HostsConfig(hosts=hosts, survive=draw(st.none() | st.integers(0, 3)))


def planned(
    scenario: Scenario, hosts: HostsConfig, keepers: Mapping[str, str] = MappingProxyType({})
) -> Plan | None:
    """The plan, or None where a sentence says what the machines lack."""
    refusal = ""
    try:
        return make_plan(scenario, hosts, "run", keepers)
    except ConfigError as error:
        refusal = str(error)
    assert "\n" not in refusal
    assert refusal.startswith(("hosts: ", "survive: "))
    return None


Made = tuple[Scenario, HostsConfig, Plan]


def carried(hosts: st.SearchStrategy[HostsConfig]) -> st.SearchStrategy[Made]:
    """Scenarios, machines that carry them, and their plans."""
    made = st.builds(lambda scenario, hosts: (scenario, hosts, planned(scenario, hosts)), SCENARIOS, hosts)
    return made.filter(lambda each: each[2] is not None)  # type: ignore[return-value]


MADE = carried(machines())
PLANS = MADE.map(lambda made: made[2])


@settings(max_examples=few(150), deadline=None)
@given(MADE)
def test_every_process_runs_once_where_it_may_and_apart_from_those_that_do_the_same_job(made: Made) -> None:
    _, hosts, plan = made
    ran = Counter((process.role, process.id) for _, process in plan.processes)
    assert set(ran.values()) == {1}
    routers = {("router", str(n)) for n in range(sum("router" in host.roles for host in hosts.hosts))}
    keepers = {("keeper", str(n)) for n in range(hosts.losses + 1)}
    table = {(spec.role, spec.id) for spec in processes_of(plan.scenario)}
    if not any("monitor" in host.roles for host in hosts.hosts):
        table.remove(("monitor", "0"))
    assert set(ran) == table | routers | keepers
    assert min(plan.scenario.standbys.planner, plan.scenario.standbys.targets) >= hosts.losses
    may = {host.name: host.roles for host in hosts.hosts}
    assert all(process.role in may[host.name] for host, process in plan.processes)
    if len(hosts.hosts) > 1:
        for host in plan.hosts:
            jobs = Counter(process.job for process in host.processes)
            assert not {job: times for job, times in jobs.items() if times > 1}
    assert [host.has_files for host in plan.hosts] == [
        bool(host.of("keeper") + host.of("targets")) for host in plan.hosts
    ]


@settings(max_examples=few(150), deadline=None)
@given(PLANS)
def test_consecutive_agents_run_together(plan: Plan) -> None:
    order = [each.id for each in plan_agents(plan.scenario)]
    runs = [[order.index(agent.id) for agent in host.of("agent")] for host in plan.hosts]
    for run in filter(None, runs):
        assert run == list(range(run[0], run[-1] + 1))


@settings(max_examples=few(150), deadline=None)
@given(carried(machines(st.just(HOST_ROLES))).map(lambda made: made[2]))
def test_machines_have_agents_by_their_cores(plan: Plan) -> None:
    """A machine that has agents is as full of router, launcher and agents as the others, to one agent."""
    largest = max(process.cores for _, process in plan.processes if process.role == "agent")
    full = {
        host.name: cores_of(plan.scenario)[LAUNCHER]
        + sum(process.cores for process in host.of("router") + host.of("agent"))
        for host in plan.hosts
    }
    for host in plan.hosts:
        if host.of("agent"):
            assert all(
                (full[host.name] - largest) / host.cores <= (full[each.name] + largest) / each.cores
                for each in plan.hosts
            )


@settings(max_examples=few(150), deadline=None)
@given(SCENARIOS, machines(st.just(HOST_ROLES)))
def test_like_machines_are_equally_loaded_but_for_a_process_of_each_job(
    scenario: Scenario, hosts: HostsConfig
) -> None:
    alike = msgspec.structs.replace(
        hosts, hosts=tuple(msgspec.structs.replace(host, cores=4.0) for host in hosts.hosts)
    )
    plan = planned(scenario, alike)
    if plan is None:
        return
    loads = [host.load for host in plan.hosts]
    largest = max(process.cores for _, process in plan.processes)
    assert max(loads) - min(loads) <= 2 * largest + 1e-9


@settings(max_examples=few(150), deadline=None)
@given(PLANS)
def test_planners_of_an_added_target_start_on_one_machine_each_and_one_with_the_ground_records(plan: Plan) -> None:
    ranks, records = [], []
    for host in filter(lambda host: host.processes, plan.hosts):
        table = chosen_processes(plan.scenario, [process.selector for process in host.processes], None)
        assert [spec.name for spec in table] == [process.name for process in host.processes]
        launcher = UpOptions(plan.scenario, Path(), table)
        ranks += launcher.ranks_of_added
        assert len(launcher.ranks_of_added) <= 1 or len(plan.hosts) == 1
        records += [host] if launcher.records else []
    assert sorted(ranks) == list(range(plan.scenario.standbys.planner + 1))
    assert [(host.name, host.has_files) for host in records] == [(plan.records, True)]


@settings(max_examples=few(150), deadline=None)
@given(PLANS)
def test_each_two_routers_have_one_link_and_every_process_a_router_that_admits_it(plan: Plan) -> None:
    reached = {f"tls/{host.address}:{plan.port}": host.name for host in plan.hosts if host.listen}
    links: dict[frozenset[str], int] = defaultdict(int)
    for host in plan.hosts:
        assert bool(host.listen) == bool(host.of("router"))
        for peer in host.peers:
            links[frozenset((host.name, reached[peer]))] += 1
        local = f"tls/127.0.0.1:{plan.port}"
        assert host.connect[0] == local if host.listen else local not in host.connect
        assert len(host.connect) == len(reached), "every router, nearest first"
    pairs = len(reached) * (len(reached) - 1) // 2
    assert (len(links), set(links.values())) == (pairs, {1} if pairs else set())
    admitted = access_control("swarm", plan.scenario.network.admit)
    names = {name for subject in admitted["subjects"] for name in subject.get("cert_common_names", ())}
    assert {process.certificate for _, process in plan.processes} | {host.operator for host in plan.hosts} <= names


@given(SCENARIOS, machines())
@settings(max_examples=few(20), deadline=None)
def test_a_plan_is_the_same_each_time(scenario: Scenario, hosts: HostsConfig) -> None:
    assert planned(scenario, hosts) == planned(scenario, hosts)


@given(SCENARIOS, machines(), st.data())
@settings(max_examples=few(100), deadline=None)
def test_a_keeper_stays_with_its_store_while_its_machine_may_have_one(
    scenario: Scenario, hosts: HostsConfig, data: st.DataObject
) -> None:
    first = planned(scenario, hosts)
    if first is None or len(hosts.hosts) == 1:
        return
    before = {keeper.id: host.name for host in first.hosts for keeper in host.of("keeper")}
    gone = data.draw(st.sampled_from(hosts.hosts))
    left = tuple(host for host in hosts.hosts if host is not gone)
    fewer = msgspec.structs.replace(hosts, hosts=tuple(data.draw(st.permutations(left))))
    second = planned(scenario, fewer, before)
    if second is None:
        return
    after = {keeper.id: host.name for host in second.hosts for keeper in host.of("keeper")}
    assert {id: name for id, name in before.items() if name != gone.name and id in after}.items() <= after.items()
