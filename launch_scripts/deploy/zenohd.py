"""Configuration for zenohd as the router of a swarm: storages for marks, and access control."""

from __future__ import annotations

from typing import Any

from swarm.bus.access_control import access_control
from swarm.bus.zenoh_config import tls_settings
from swarm.config.scenario import NetworkConfig
from swarm.wire.codec import MAX_PAYLOAD_BYTES
from swarm.wire.topics import MARKS


def zenohd_config(
    network: NetworkConfig,
    *,
    plugins: str | None = None,
    volume: str = "memory",
) -> dict[str, Any]:
    """The configuration that `zenohd -c FILE` reads, as JSON.

    plugins  folder of `libzenoh_plugin_storage_manager.so`; without one marks are passed on, not stored
    volume   of the storage: "memory", or one whose backend is installed
    With certificates the names in `network.admit` may take part, under the rules of `swarm router`. Raises
    ConfigError on one that no process can have.
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
    if network.tls is not None:
        config["access_control"] = access_control(network.namespace, network.admit, network.revoked)
    return config
