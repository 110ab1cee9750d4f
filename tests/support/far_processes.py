"""Processes beside a test or a measurement, on one router; each answers questions over a pipe."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from launch_scripts.ports import free_ports
from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig
from swarm.errors import SwarmError

NAMESPACE = "bench"
_READY_S = 60.0
_END_S = 5.0


class Far:
    """Processes beside this one, on one router. They end with the context.

    network  whose router runs already; by default one is started
    """

    def __init__(self, network: NetworkConfig | None = None) -> None:
        self._starts_router = network is None
        self.network = network or on_free_port(NAMESPACE)
        self._spawning = multiprocessing.get_context("spawn")
        self._running: list[tuple[BaseProcess, Connection]] = []

    def __enter__(self) -> Far:
        if self._starts_router:
            self.start(_router)
        return self

    def __exit__(self, *_: object) -> None:
        while self._running:
            self.end()

    def start(self, run: Callable[..., None], *given: Any) -> Connection:
        """Runs `run(network, pipe, *given)` in a process; returns once it has sent "ready"."""
        here, there = self._spawning.Pipe()
        process = self._spawning.Process(target=run, args=(self.network, there, *given), daemon=True)
        # A Ctrl-C reaches the whole process group. These are ended by us, in order.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._running.append((process, here))
        if not here.poll(_READY_S) or here.recv() != "ready":
            raise SwarmError(f"the process {run.__name__} was not ready within {_READY_S:.0f} s")
        return here

    def end(self) -> None:
        """Ends the process which was started last."""
        process, pipe = self._running.pop()
        with contextlib.suppress(OSError):  # it may have ended already
            pipe.send("end")
        process.join(_END_S)
        if process.is_alive():
            process.kill()
            process.join(_END_S)


def on_free_port(namespace: str = "swarm") -> NetworkConfig:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    return NetworkConfig(namespace=namespace, listen=(endpoint,), connect=(endpoint,))


def asked(far: Connection, *question: Any, within_s: float = 60.0) -> Any:
    """Asks a process over its pipe and returns its answer."""
    far.send(question)
    return answered(far, question[0], within_s)


def answered(far: Connection, what: object, within_s: float) -> Any:
    """The answer to the question that was sent last."""
    if not far.poll(within_s):
        raise SwarmError(f"no answer to {what} within {within_s:.0f} s")
    return far.recv()


def _router(network: NetworkConfig, pipe: Connection) -> None:
    with open_bus(network, mode="router"):
        pipe.send("ready")
        pipe.recv()
