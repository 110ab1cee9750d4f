"""The configuration of a Zenoh session: client or router, endpoints, leases, TLS."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from swarm.bus.access_control import access_control
from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.wire.codec import MAX_PAYLOAD_BYTES


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
        if network.tls is not None:
            settings["access_control"] = access_control(network.namespace, network.admit, network.revoked)
    else:
        settings["listen/endpoints"] = []
        settings["connect/endpoints"] = list(network.connect)
        settings["connect/timeout_ms"] = int(network.connect_timeout_s * 1000)
    settings["connect/retry"] = {
        "period_init_ms": 100,
        "period_max_ms": 500,
        "period_increase_factor": 1.5,
    }
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
