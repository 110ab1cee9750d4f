"""The configuration of Zenoh: a session's endpoints, leases and TLS; a router's access control and limits of
payloads, from the table of topics.

Zenoh allows a message if a rule's key expression includes the whole key expression of the message. It identifies a
peer by the whole common name of its certificate. Each name therefore has its own rules.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import zenoh

from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.config.setting_types import RESERVED_GROUPS
from swarm.errors import ConfigError
from swarm.peers import job_of
from swarm.wire.access import CODE_BYTES, MEMBERS, ROLES, Grant
from swarm.wire.codec import MAX_PAYLOAD_BYTES
from swarm.wire.fields import check_id
from swarm.wire.messages.map_data import KEEPERS
from swarm.wire.topics import ALIVE_KEY, TOPICS, asker_of

ROUTER = "router"
_EVERYTHING = (
    "put", "delete", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token",
    "declare_liveliness_subscriber", "liveliness_query",
)  # fmt: skip
_LOOPBACK = "loopback"


@dataclass(frozen=True, slots=True)
class Bearer:
    """The name to which a certificate was issued.

    name    `ROLE.ID`, for an agent `agent.GROUP.ID`, for a rover that marks `rover.GROUP.ID`
    author  what its ids as an author begin with: the group and id of an agent or rover, of a keeper "keeper" and
            its id, else the id
    """

    name: str
    role: str
    id: str
    author: str

    def own(self, field: str) -> str:
        """Required value of a key's field where it must be the bearer's own. A standby serves its job's."""
        own = {"role": self.role, "author": f"{self.author}.$*", "target": job_of(self.id)}
        own["places"] = job_of(self.id)
        own["asker"] = asker_of(self.role, self.id)
        return own.get(field, self.id)


def bearer(name: str) -> Bearer:
    """The bearer of a name such as keeper.0, planner.t3 or agent.all.a0. Raises ConfigError on another form."""
    role, _, author = name.partition(".")
    group, _, id = author.rpartition(".")
    try:
        check_id("name", name)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if role not in (*ROLES, ROUTER) or not author or (role == "agent" and not (group and id)):
        roles = ", ".join((ROUTER, *ROLES))
        raise ConfigError(
            f"{name!r} is no name of a process: write ROLE.ID or agent.GROUP.ID, such as planner.t0; the roles are"
            f" {roles}"
        )
    first = author.split(".")[0]
    if role in ("agent", "rover") and first in RESERVED_GROUPS:
        raise ConfigError(
            f"{name!r} is no name of a process: no group is called {first!r}, as {RESERVED_GROUPS[first]}"
        )
    if role == "keeper":
        return Bearer(name, role, author, f"{KEEPERS}.{author}")
    return Bearer(name, role, id if role in ("agent", "rover") else author, author)


def common_name(name: str, revoked: Collection[str]) -> str:
    """Returns the common name in the certificate of a name: the name itself, or `NAME~2` if that was revoked, and
    so on. A process whose certificate is lost therefore gets another one under the same name."""
    candidate, issue = name, 1
    while candidate in revoked:
        issue += 1
        candidate = f"{name}~{issue}"
    return candidate


def patterned(key: str) -> str:
    """A key expression of a subscription or queryable, so that it begins with a wildcard: routers number no part of
    such a one, and so can confuse none (docs/design/misrouted-keys.md). It also matches in each namespace with
    the same ending: a receiver compares the namespace."""
    return f"$*{key}"


def _declared(keys: list[str]) -> list[str]:
    """Key expressions which a process may declare in order to hear or serve these: as they are, and patterned."""
    return keys + [patterned(key) for key in keys]


def access_control(namespace: str, names: Iterable[str], revoked: Collection[str] = ()) -> dict[str, Any]:
    """Returns the value of a router's `access_control`: each name may do what the table of topics grants to its
    role, and any other name is denied everything. Links over tcp/ have no names; they stay open, as
    `check_endpoint` lets them be on loopback only. Raises ConfigError on a name that no process can have.

    revoked  common names that are denied everything from now on
    """
    all_keys = _declared([f"{namespace}/**"])
    rules = [_rule("everything", flow, _EVERYTHING, all_keys) for flow in ("ingress", "egress")]
    everything = [rule["id"] for rule in rules]
    subjects: list[dict[str, Any]] = [{"id": _LOOPBACK, "link_protocols": ["tcp"]}]
    policies = [{"rules": everything, "subjects": [_LOOPBACK]}]
    for name in dict.fromkeys(names):
        who = bearer(name)
        own = [] if who.role == ROUTER else _rules(namespace, who)
        rules += own
        subjects.append({"id": name, "cert_common_names": [common_name(name, revoked)]})
        policies.append({"rules": [rule["id"] for rule in own] or everything, "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def low_pass_filter(namespace: str) -> list[dict[str, Any]]:
    """Returns the value of a router's `low_pass_filter`: it drops a payload which no receiver would read, as it is
    longer than the table of topics allows. With certificates a key has one author, so a limit by key is one by
    author."""
    return [
        {
            "id": f"{topic.name} {message}",
            "flows": ["ingress"],
            "messages": [message],
            "key_exprs": [topic.expression(namespace)],
            "size_limit": most_bytes + CODE_BYTES,
        }
        for topic in TOPICS
        for message, used, most_bytes in (
            ("put", topic.published, topic.put_bytes),
            ("query", topic.request is not None, topic.ask_bytes),
            ("reply", topic.request is not None, topic.answer_bytes),
        )
        if used
    ]


def _rules(namespace: str, who: Bearer) -> list[dict[str, Any]]:
    """Messages from a bearer are limited to its own keys. Queries that go to it are limited to topics: one may name
    many keys, and reaches a process only where that was allowed to serve one of them."""
    token = f"{namespace}/{ALIVE_KEY.format(role=who.role, id=who.id, incarnation='*')}"
    tokens = f"{namespace}/{ALIVE_KEY.format(role='*', id='*', incarnation='*')}"
    table = {name: list(_keys(namespace, who, name)) for name in ("put", "serve", "ask", "hear")}
    wide = {name: list(_keys(namespace, who, name, own=False)) for name in ("serve", "ask")}
    rows = (
        ("ingress", ("put",), table["put"]),
        ("ingress", ("declare_queryable",), _declared(table["serve"])),
        ("ingress", ("reply",), table["serve"]),
        ("ingress", ("query",), table["ask"]),
        ("ingress", ("declare_subscriber",), _declared(table["hear"])),
        ("ingress", ("liveliness_token",), [token] if who.role in MEMBERS.split() else []),
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query"), _declared([tokens])),
        ("egress", ("put",), table["hear"]),
        ("egress", ("query",), wide["serve"]),
        ("egress", ("reply",), wide["ask"]),
        ("egress", ("liveliness_token",), [tokens]),
    )
    return [_rule(who.name, flow, messages, keys) for flow, messages, keys in rows if keys]


def _keys(namespace: str, who: Bearer, operation: str, *, own: bool = True) -> Iterator[str]:
    """Key expressions on which a bearer may do something; with `own` limited to what must be its own."""
    for topic in TOPICS:
        grants: tuple[Grant, ...] = getattr(topic.access, operation)
        for grant in grants:
            if grant.role == who.role:
                fields = dict.fromkeys(topic.fields, "*")
                if own:
                    fields |= {field: who.own(field) for field in grant.own}
                yield f"{namespace}/{topic.key.format(**fields)}"


def _rule(name: str, flow: str, messages: Iterable[str], keys: list[str]) -> dict[str, Any]:
    messages = list(messages)
    return {
        "id": f"{name} {flow} {messages[0]}",
        "permission": "allow",
        "flows": [flow],
        "messages": messages,
        "key_exprs": keys,
    }


def session_config(network: NetworkConfig, mode: str) -> zenoh.Config:
    """Returns the configuration for `zenoh.open`. Nothing is discovered: sessions meet at the endpoints of the
    scenario only.

    mode  "client" or "router"; a router with certificates admits only the processes in `network.admit`
    Raises ConfigError on a name that no process can have.
    """
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/unicast/max_sessions": 8192,
        "transport/unicast/accept_pending": 20_000,  # silent connections, which end after the timeout
        "transport/unicast/accept_timeout": 2_000,
        "transport/link/tx/lease": int(network.lease_s * 1000),
        "transport/link/tx/keep_alive": 4,
        "transport/link/rx/max_message_size": MAX_PAYLOAD_BYTES + (1 << 16),
        "transport/shared_memory/enabled": False,
    }
    if mode == "router":
        settings["listen/endpoints"] = list(network.listen)
        settings["listen/exit_on_failure"] = True
        settings["connect/endpoints"] = list(network.peers)
        settings["connect/exit_on_failure"] = False
        settings["low_pass_filter"] = low_pass_filter(network.namespace)
        if network.tls is not None:
            settings["access_control"] = access_control(network.namespace, network.admit, network.revoked)
    else:
        settings["listen/endpoints"] = []
        settings["connect/endpoints"] = list(network.connect)
        settings["connect/timeout_ms"] = int(network.connect_timeout_s * 1000)
    settings["connect/retry"] = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
    if network.tls is not None:
        settings["transport/link/tls"] = tls_settings(network.tls)
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def tls_settings(tls: TlsConfig) -> dict[str, Any]:
    """Zenoh's words for mutual TLS, with one certificate for listening and connecting."""
    return {
        "root_ca_certificate": tls.ca,
        "enable_mtls": True,
        "listen_certificate": tls.certificate,
        "listen_private_key": tls.key,
        "connect_certificate": tls.certificate,
        "connect_private_key": tls.key,
    }
