"""Configuration for zenohd as the router of a swarm: storages for marks, and access control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from swarm.bus.zenoh_config import tls_settings
from swarm.config.scenario import NetworkConfig
from swarm.wire.codec import MAX_PAYLOAD_BYTES
from swarm.wire.topics import (
    ALIVE_KEY,
    DIGEST,
    FLEET,
    FOLLOWED,
    MARKS,
    NOTE,
    RESERVATIONS,
    SIGHTED,
    STATS,
    TERRITORY,
)

ANSWERS = ("declare_queryable", "reply")
PUTS = ("put", "delete", *ANSWERS, "liveliness_token")
READS = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")


def zenohd_config(
    network: NetworkConfig,
    *,
    trusted: Sequence[str] = (),
    agents: Sequence[str] = (),
    plugins: str | None = None,
    volume: str = "memory",
) -> dict[str, Any]:
    """The configuration that `zenohd -c FILE` reads, as JSON.

    trusted  certificate names that may do everything in the namespace: keepers, planners, routers
    agents   certificate names of agents, each its group and id (all.a0): may write only what is their own
    plugins  folder of `libzenoh_plugin_storage_manager.so`; without one marks are passed on, not stored
    volume   of the storage: "memory", or one whose backend is installed
    With names given, whoever has another one, or none, may do nothing. Without, all that connect may do all.
    """
    config: dict[str, Any] = {
        "mode": "router",
        "listen": {"endpoints": list(network.listen), "exit_on_failure": True},
        "connect": {"endpoints": list(network.peers), "exit_on_failure": False},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": {"max_sessions": 8192, "accept_pending": 2048},
            "link": {
                "tx": {"lease": int(network.lease_s * 1000), "keep_alive": 4},
                "rx": {"max_message_size": MAX_PAYLOAD_BYTES + (1 << 16)},
            },
            "shared_memory": {"enabled": False},
        },
        # A storage keeps what has the newest stamp, so all values need one: the router gives it where a session
        # does not. Which set is the newer is told by (epoch, seq) inside; the stamps need not agree with it.
        "timestamping": {"enabled": {"router": True, "peer": False, "client": False}},
    }
    if network.tls is not None:
        config["transport"]["link"]["tls"] = tls_settings(network.tls)
    if plugins is not None:
        config["plugins_loading"] = {"enabled": True, "search_dirs": [plugins]}
        storage = {"key_expr": MARKS.expression(network.namespace), "volume": volume}
        config["plugins"] = {"storage_manager": {"__required__": True, "storages": {"marks": storage}}}
    if trusted or agents:
        config["access_control"] = access_control(network.namespace, trusted, agents)
    return config


def access_control(namespace: str, trusted: Sequence[str], agents: Sequence[str]) -> dict[str, Any]:
    """Access control rules, by the common name of the certificate at the other end of a link.

    An agent hears everything and writes under its own name only: authors are called `GROUP.ID.INCARNATION`. It
    answers for others, too, where it is asked for the newest reservations of those that are gone.
    """
    whole = [f"{namespace}/**"]
    rules = [_rule("all", (*PUTS, *READS), whole), _rule("hear", READS, whole)]
    # Egress is a rule of its own: messages of others must reach those that may hear them.
    rules.append(_rule("told", PUTS, whole, flows=["egress"]))
    rules.append(_rule("asked", READS, whole, flows=["egress"]))
    # Only those which heard a dead agent last know where its vehicles stand.
    rules.append(_rule("relayed", ANSWERS, [RESERVATIONS.expression(namespace)]))
    policies = [{"rules": ["all"], "subjects": ["trusted"]}] if trusted else []
    subjects = [{"id": "trusted", "cert_common_names": list(trusted)}] if trusted else []
    for agent in agents:
        rules.append(_rule(f"own-{agent}", PUTS, [f"{namespace}/{key}" for key in own_keys(agent)]))
        subjects.append({"id": agent, "cert_common_names": [agent]})
        policies.append({"rules": ["hear", "told", "asked", "relayed", f"own-{agent}"], "subjects": [agent]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def own_keys(name: str) -> list[str]:
    """Keys below the namespace that an agent with a name such as all.a0 may write."""
    author, agent = f"{name}.$*", name.rpartition(".")[2]
    return [
        MARKS.key.format(region="*", tile="*", author=author),
        DIGEST.key.format(author=author),
        FLEET.key.format(region="*", author=author),
        SIGHTED.key.format(target="*", author=author),
        RESERVATIONS.key.format(agent=agent),
        TERRITORY.key.format(agent=agent),
        FOLLOWED.key.format(agent=agent, vehicle="*"),
        STATS.key.format(role="agent", id=agent),
        NOTE.key.format(role="agent", id=agent),
        f"run/agent/{agent}",
        ALIVE_KEY.format(role="agent", id=agent, incarnation="*"),
    ]


def _rule(id: str, messages: Sequence[str], keys: list[str], flows: Sequence[str] = ("ingress", "egress")) -> Any:
    return {
        "id": id,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": keys,
    }
