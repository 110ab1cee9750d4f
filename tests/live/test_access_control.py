"""Access control as it is enforced: every role, every key, every operation, with real certificates and sessions.

A session with a router's certificate is the counterpart: it may do everything. Each role tries every key of the
table, its own and those of others, and the successful attempts are compared with the table.
"""

import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec
import pytest
import zenoh
from support.processes import eventually
from support.zenohd import Zenohd

from launch_scripts.deploy.certificates import issue
from launch_scripts.launcher.router import FREE_TRIES, Admission
from launch_scripts.ports import free_ports
from swarm.bus.zenoh_config import ROUTER, Bearer, bearer, common_name, patterned, session_config
from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.endpoints import host_port
from swarm.wire.access import MEMBERS, ROLES
from swarm.wire.topics import ALIVE_KEY, TOPICS, Topic

pytestmark = pytest.mark.network

NAMES = {
    "keeper": "keeper.east",
    "planner": "planner.t0",
    "standby": "planner.t0.r1",
    "places": "places.red",
    "agent": "agent.blue.a0",
    "targets": "targets.0",
    "tracker": "tracker.t0",
    "rover": "rover.all.r1",
    "monitor": "monitor.0",
    "operator": "operator.anna",
}
OUTSIDER = "agent.blue.a7"
"""The client has a certificate of the same authority, and no router admits it."""
REVOKED, ISSUED_AGAIN = "agent.blue.a8", "agent.blue.a9"
SETTLE_S = 0.2
LATEST_S = 5.0
NAMESPACE = "swarm"
ALL = f"{NAMESPACE}/**"
OPERATIONS = ("put", "delete", "serve", "ask", "hear", "raise", "watch", "look")
EVERYBODY = (*ROLES, "standby", "outsider", "revoked")

FORBIDDEN = [
    ("agent", "put", "marks/0/0/red.a1.1"),
    ("agent", "put", "marks/0/0/blue.a01.1"),
    ("agent", "put", "reservations/a1"),
    ("agent", "put", "target/t0/pose"),
    ("agent", "put", "target/t0/chasers/red.a1.1"),
    ("agent", "hear", "target/t0/chasers/blue.a0.1"),
    ("agent", "put", "vehicle/a1/v0/route"),
    ("agent", "put", "stats/router/0"),
    ("agent", "serve", "run/agent/zz"),
    ("agent", "serve", "run/keeper/0"),
    ("agent", "serve", "target/t0/route"),
    ("agent", "ask", "target/t0/route/agent.a1"),
    ("agent", "ask", "target/t0/cost/rover.a0"),
    ("agent", "ask", "target/t0/route/*"),
    ("rover", "ask", "target/t0/cost/agent.r1"),
    ("agent", "hear", "vehicle/a1/*/route"),
    ("agent", "hear", "**"),
    ("agent", "raise", "alive/agent/zz/1"),
    ("agent", "raise", "alive/router/0/1"),
    ("planner", "serve", "target/t1/route"),
    ("planner", "serve", "target/*/route"),
    ("planner", "serve", "**"),
    ("planner", "put", "target/t0/pose"),
    ("planner", "hear", "world/target/t0/pose"),
    ("planner", "hear", "target/t1/chasers/blue.a0.1"),
    ("planner", "raise", "alive/planner/t1/1"),
    ("standby", "serve", "target/t1/route"),
    ("standby", "serve", "target/t0.r1/route"),
    ("standby", "serve", "run/planner/t0"),
    ("standby", "put", "lead/planner/t0"),
    ("standby", "put", "stats/planner/t0"),
    ("standby", "raise", "alive/planner/t0/1"),
    ("places", "serve", "place/blue/route/agent.a0"),
    ("places", "serve", "target/t0/route"),
    ("places", "put", "marks/0/0/blue.a0.1"),
    ("agent", "serve", "place/red/route/agent.a0"),
    ("agent", "ask", "place/red/route/agent.a1"),
    ("monitor", "put", "marks/0/0/blue.a0.1"),
    ("operator", "put", "note/operator/anna"),
    ("operator", "raise", "alive/operator/anna/1"),
    ("tracker", "put", "target/t1/pose"),
    ("rover", "put", "body/r2"),
    ("rover", "put", "target/t0/pose"),
    ("rover", "put", "marks/0/0/all.r2.1"),
    ("rover", "hear", "vehicle/r2/r2/route"),
    ("rover", "raise", "alive/agent/r1/1"),
    ("agent", "put", "body/r1"),
    ("outsider", "hear", "**"),
    ("outsider", "ask", "**"),
    ("outsider", "put", "marks/0/0/blue.a7.1"),
    ("outsider", "raise", "alive/agent/a7/1"),
    ("revoked", "hear", "fleet/0/blue.a0.1"),
    ("revoked", "raise", "alive/agent/a8/1"),
]
"""Written by hand, in case the table itself were wrong."""


@dataclass(frozen=True)
class Case:
    """An attempt: a key below the namespace, and whether the table allows it to this bearer."""

    operation: str
    key: str
    allowed: bool


def cases(who: Bearer | None) -> list[Case]:
    """Each operation on each topic, under keys that are the bearer's own and keys of which one field is not.

    who  None for a process that may do nothing
    """
    tried = who or bearer(OUTSIDER)
    found = []
    for topic in TOPICS:
        own = {field: tried.own(field).replace("$*", "1") for field in topic.fields}
        keys = {topic.key.format(**own)}
        keys |= {topic.key.format(**(own | {field: other(field)})) for field in topic.fields}
        keys.add(topic.key.format(**{field: other(field) for field in topic.fields}))
        for operation in ("put", "delete", "serve", "ask", "hear"):
            found += [Case(operation, key, allows(who, topic, operation, key)) for key in sorted(keys)]
    for role in (*ROLES, ROUTER, "zz"):
        for id in (tried.id, "zz"):
            key = ALIVE_KEY.format(role=role, id=id, incarnation=1)
            mine = who is not None and (role, id) == (who.role, who.id) and role in MEMBERS.split()
            found += [
                Case("raise", key, mine),
                Case("watch", key, who is not None),
                Case("look", key, who is not None),
            ]
    return found


def other(field: str) -> str:
    return {"author": "red.a1.1", "role": "zz"}.get(field, "zz")


def allows(who: Bearer | None, topic: Topic, operation: str, key: str) -> bool:
    """The permissions by the table alone, without the code that makes the router's rules."""
    if who is None or operation == "delete":
        return False
    fields = topic.parse(NAMESPACE, f"{NAMESPACE}/{key}")
    assert fields is not None
    for grant in getattr(topic.access, operation):
        if grant.role == who.role:
            own = {"role": who.role, "author": f"{who.author}.1", "target": who.id.removesuffix(".r1")}
            own["asker"] = f"{who.role}.{who.id}"
            return all(fields[field] == own.get(field, who.id) for field in grant.own)
    return False


class Trial:
    """A role's session and the one that may do everything, between them the router's access control."""

    def __init__(self, tried: zenoh.Session, counterpart: zenoh.Session) -> None:
        self.tried = tried
        self.counterpart = counterpart

    def passed(self, operation: str, keys: list[str], expected: set[str]) -> set[str]:
        """The keys on which the operation got through. Waits for those that are expected, and then for others."""
        got: set[str] = set()
        whole = [f"{NAMESPACE}/{key}" for key in keys]
        with ExitStack() as stack:
            getattr(self, f"_{operation}")(whole, got, stack)
            until_s = time.monotonic() + LATEST_S
            while not got >= {f"{NAMESPACE}/{key}" for key in expected} and time.monotonic() < until_s:
                time.sleep(0.02)
            time.sleep(SETTLE_S)
        return {key.removeprefix(f"{NAMESPACE}/") for key in got}

    def _put(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        self._collect(got, stack)
        for key in keys:
            self.tried.put(key, b"x")

    def _delete(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        self._collect(got, stack)
        for key in keys:
            self.tried.delete(key)

    def _collect(self, got: set[str], stack: ExitStack) -> None:
        everything = self.counterpart.declare_subscriber(ALL, adding(got))
        stack.callback(everything.undeclare)
        time.sleep(SETTLE_S)

    def _hear(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        for key in forms(keys):
            stack.callback(self.tried.declare_subscriber(key, adding(got)).undeclare)
        time.sleep(SETTLE_S)
        for key in keys:
            self.counterpart.put(concrete(key), b"x")

    def _ask(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        everybody = self.counterpart.declare_queryable(ALL, reply)
        stack.callback(everybody.undeclare)
        time.sleep(SETTLE_S)
        got |= {key for key in keys if replies(self.tried, key)}

    def _serve(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        for key in forms(keys):
            stack.callback(self.tried.declare_queryable(key, reply).undeclare)
        time.sleep(SETTLE_S)
        got |= {key for key in keys if replies(self.counterpart, concrete(key))}
        # A queryable that is allowed may still reply under keys that are not.
        for key in keys:
            liar = self.tried.declare_queryable(key, lambda query: reply_under(query, keys))
            stack.callback(liar.undeclare)
        time.sleep(SETTLE_S)
        got |= replies(self.counterpart, ALL)

    def _raise(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        watcher = self.counterpart.liveliness().declare_subscriber(ALL, adding(got), history=True)
        stack.callback(watcher.undeclare)
        for key in keys:
            stack.callback(self.tried.liveliness().declare_token(key).undeclare)

    def _watch(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        for key in forms(keys):
            watcher = self.tried.liveliness().declare_subscriber(key, adding(got), history=True)
            stack.callback(watcher.undeclare)
        for key in keys:
            stack.callback(self.counterpart.liveliness().declare_token(key).undeclare)

    def _look(self, keys: list[str], got: set[str], stack: ExitStack) -> None:
        for key in keys:
            stack.callback(self.counterpart.liveliness().declare_token(key).undeclare)
        time.sleep(SETTLE_S)
        for key in keys:
            got |= {str(each.ok.key_expr) for each in self.tried.liveliness().get(key, timeout=1.0) if each.ok}


def adding(got: set[str]) -> Callable[[zenoh.Sample], None]:
    """A listener that notes the keys of samples."""
    return lambda sample: got.add(str(sample.key_expr))


def forms(keys: list[str]) -> list[str]:
    """Key expressions of declarations: every second one begins with a wildcard, as those of our buses."""
    return [patterned(key) if number % 2 else key for number, key in enumerate(keys)]


def concrete(key: str) -> str:
    return key.replace("**", "x").replace("*", "x")


def reply(query: zenoh.Query) -> None:
    query.reply(query.key_expr, b"x")
    query.drop()


def reply_under(query: zenoh.Query, keys: list[str]) -> None:
    for key in keys:
        if query.key_expr.intersects(zenoh.KeyExpr(key)):
            query.reply(key, b"x")
    query.drop()


def replies(session: zenoh.Session, selector: str) -> set[str]:
    asked = session.get(
        selector, timeout=1.0, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE
    )
    return {str(reply.ok.key_expr) for reply in asked if reply.ok}


class Stage:
    """A router with access control, and sessions with certificates of their own."""

    admission: Admission
    """The session of our own router, if it is that."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self.stack = stack
        self.endpoint = f"tls/localhost:{free_ports(1)[0]}"
        issue(folder, "router.0", ["localhost"], 2)

    def network(self, name: str, **changes: object) -> NetworkConfig:
        if not (self.folder / f"{name}.pem").exists():
            issue(self.folder, name, [], 2)
        ca, certificate, key = (str(self.folder / file) for file in ("ca.pem", f"{name}.pem", f"{name}.key"))
        network = NetworkConfig(
            listen=(self.endpoint,),
            connect=(self.endpoint,),
            admit=("router.0", "router.north", *NAMES.values(), REVOKED, ISSUED_AGAIN),
            revoked=(REVOKED, ISSUED_AGAIN),
            tls=TlsConfig(ca=ca, certificate=certificate, key=key),
        )
        return msgspec.structs.replace(network, **changes)

    def open(self, name: str, mode: str = "client", **changes: object) -> zenoh.Session:
        session = zenoh.open(session_config(self.network(name, **changes), mode))
        self.stack.callback(session.close)
        return session


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    with ExitStack() as stack:
        yield Stage(tmp_path_factory.mktemp("certs"), stack)


@pytest.fixture(scope="module")
def routed(stage: Stage) -> Stage:
    """With our own router, behind its door."""
    stage.admission = Admission(stage.network("router.0"))
    stage.stack.callback(stage.admission.close)
    return stage


@pytest.fixture(scope="module")
def routed_by_zenohd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    with ExitStack() as stack:
        stage = Stage(tmp_path_factory.mktemp("zenohd"), stack)
        stack.enter_context(Zenohd(stage.folder, stage.network("router.0")))
        yield stage


@pytest.mark.parametrize("role", EVERYBODY)
def test_on_our_router_each_role_does_what_the_table_allows_and_nothing_else(role: str, routed: Stage) -> None:
    compare(role, routed)


@pytest.mark.zenohd
@pytest.mark.parametrize("role", EVERYBODY)
def test_on_zenohd_each_role_does_as_the_table_allows_and_nothing_else(role: str, routed_by_zenohd: Stage) -> None:
    compare(role, routed_by_zenohd)


def compare(role: str, stage: Stage) -> None:
    name = {"outsider": OUTSIDER, "revoked": REVOKED}.get(role) or NAMES[role]
    tried, counterpart = stage.open(name), stage.open("router.0")
    trial = Trial(tried, counterpart)
    table = cases(bearer(name) if role in NAMES else None)
    table += [Case(operation, key, False) for who, operation, key in FORBIDDEN if who == role]
    for operation in OPERATIONS:
        tries = [case for case in table if case.operation == operation]
        expected = {case.key for case in tries if case.allowed} - {case.key for case in tries if not case.allowed}
        assert trial.passed(operation, [case.key for case in tries], expected) == expected, operation
    for session in (tried, counterpart):
        session.close()


def test_the_matrix_tries_every_topic_both_ways_where_there_are_two() -> None:
    tried = {(role, case.operation, case.allowed) for role in NAMES for case in cases(bearer(NAMES[role]))}
    for role in ROLES:
        for operation in OPERATIONS:
            assert (role, operation, False) in tried or operation in ("watch", "look")
        assert (role, "ask", True) in tried or (role, "hear", True) in tried
    every = [case for name in NAMES.values() for case in cases(bearer(name)) if case.allowed]
    allowed = {
        (case.operation, topic.name) for topic in TOPICS for case in every if topic.parse("x", f"x/{case.key}")
    }
    for topic in TOPICS:
        assert {("put", topic.name), ("hear", topic.name)} <= allowed or not topic.published
        assert {("serve", topic.name), ("ask", topic.name)} <= allowed or topic.request is None


@pytest.mark.parametrize("said", [b"", b"\x16\x03\x01\x00\x04\x01\x00\x00\x00"], ids=["silent", "hello"])
def test_strangers_who_hang_up_keep_no_member_out(routed: Stage, said: bytes) -> None:
    """Without a door each of them would cost the router 0.1 s, so members would join after 40 s."""
    host, port = host_port(routed.endpoint)
    for _ in range(400):
        with socket.create_connection((host, port), 10) as stranger:
            stranger.sendall(said)
    members = [routed.open(NAMES["agent"]) for _ in range(3)]
    for each in members:
        each.close()


def test_who_fails_often_is_kept_out_and_no_one_else(routed: Stage) -> None:
    """A handshake without a certificate from 127.0.0.3, again and again; members come from 127.0.0.1."""
    host, port = host_port(routed.endpoint)
    context = ssl.create_default_context(cafile=str(routed.folder / "ca.pem"))
    refused = failed = 0
    for _ in range(2 * FREE_TRIES):
        with socket.create_connection((host, port), 10, source_address=("127.0.0.3", 0)) as stranger:
            try:
                with context.wrap_socket(stranger, server_hostname="localhost") as link:
                    link.recv(1)
            except (ConnectionResetError, ssl.SSLEOFError):
                refused += 1
            except ssl.SSLError:  # the router requires a certificate
                failed += 1
    assert FREE_TRIES <= failed < 2 * FREE_TRIES == failed + refused
    routed.open(NAMES["agent"]).close()


def test_a_revoked_name_is_admitted_again_with_its_next_certificate(routed: Stage) -> None:
    issue(routed.folder, ISSUED_AGAIN, [], 2, called=common_name(ISSUED_AGAIN, {ISSUED_AGAIN}))
    counterpart, again = routed.open("router.0"), routed.open(ISSUED_AGAIN)
    assert Trial(again, counterpart).passed("put", ["stats/agent/a9", "stats/agent/a0"], {"stats/agent/a9"}) == {
        "stats/agent/a9"
    }


def test_outside_of_the_namespace_no_one_may_do_anything(stage: Stage) -> None:
    endpoint = f"tls/localhost:{free_ports(1)[0]}"
    router = stage.open("router.0", "router", listen=(endpoint,))
    inside: list[str] = []
    outside: list[str] = []
    router.declare_subscriber("**", lambda sample: inside.append(str(sample.key_expr)))
    router.declare_queryable("**", reply)
    for role in ROLES:
        tried = stage.open(NAMES[role], connect=(endpoint,))
        tried.declare_subscriber("**", lambda sample: outside.append(str(sample.key_expr)))
        for key in ("other/run/agent/a0", f"@/{router.zid()}/router/config/access_control/enabled"):
            tried.put(key, b"false")
            assert replies(tried, key) == set(), role
        answered = replies(tried, "**") | replies(tried, "@/**")
        assert {key for key in answered if not key.startswith(f"@/{tried.zid()}/")} == set(), role  # but its own
        router.put("other/x", b"x")
        time.sleep(SETTLE_S)
        tried.close()
    assert inside == ["other/x"] * len(ROLES)
    assert set(outside) == {"other/run/agent/a0"}  # what it put itself, which passes no link


def test_two_routers_pass_on_what_is_allowed_and_each_keeps_out_what_is_not(stage: Stage, routed: Stage) -> None:
    endpoint = f"tls/localhost:{free_ports(1)[0]}"
    far = {"listen": (endpoint,), "connect": (endpoint,)}
    issue(stage.folder, "router.north", ["localhost"], 2)
    stage.open("router.north", "router", listen=(endpoint,), peers=(stage.endpoint,))
    agent, planner = stage.open(NAMES["agent"], **far), stage.open(NAMES["planner"])
    heard: list[str] = []
    chasers = f"{NAMESPACE}/target/t0/chasers"
    planner.declare_subscriber(f"{chasers}/*", lambda sample: heard.append(str(sample.key_expr)))
    cost = f"{NAMESPACE}/target/t0/cost"
    planner.declare_queryable(cost, lambda query: reply_under(query, [cost]))

    def met() -> bool:
        for author in ("red.a1.1", "blue.a0.1"):
            agent.put(f"{chasers}/{author}", b"x")
        return len(heard) > 2 and bool(replies(agent, f"{NAMESPACE}/target/*/cost"))

    eventually(met, 10, "the routers to meet")
    assert set(heard) == {f"{chasers}/blue.a0.1"}


def test_links_in_the_clear_stay_open_because_they_are_on_loopback_and_have_no_names(stage: Stage) -> None:
    endpoints = (f"tls/localhost:{free_ports(1)[0]}", f"tcp/127.0.0.1:{free_ports(1)[0]}")
    stage.open("router.0", "router", listen=endpoints)
    with zenoh.open(session_config(NetworkConfig(connect=endpoints[1:]), "client")) as beside:
        outsider = stage.open(OUTSIDER, connect=endpoints[:1])
        assert Trial(outsider, beside).passed("put", ["stats/agent/a7"], set()) == set()
        assert Trial(beside, beside).passed("put", ["stats/agent/a7"], {"stats/agent/a7"}) == {"stats/agent/a7"}
