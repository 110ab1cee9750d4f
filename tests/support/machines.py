"""Machines played by network namespaces on one bridge, each with an address of its own."""

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from typing import Any


class Machines:
    """The namespaces, what runs in them, and how it is ended.

    addresses    name -> address
    environment  names of the processes there
    """

    def __init__(self, addresses: Mapping[str, str], environment: Mapping[str, str]) -> None:
        self.addresses, self.environment = dict(addresses), dict(environment)
        self._mark = f"{os.getpid() % 100_000}"
        self._running: dict[str, list[subprocess.Popen[str]]] = {name: [] for name in addresses}

    def space(self, name: str) -> str:
        return f"swarm-{name}-{self._mark}"

    def build(self) -> None:
        switch = self.space("switch")
        _ip("netns", "add", switch)
        _ip("-n", switch, "link", "add", "bridge", "type", "bridge")
        _ip("-n", switch, "link", "set", "bridge", "up")
        for n, (name, address) in enumerate(self.addresses.items()):
            space, end = self.space(name), f"e{n}-{self._mark}"
            _ip("netns", "add", space)
            _ip("-n", switch, "link", "add", f"p{n}", "type", "veth", "peer", "name", end)
            _ip("-n", switch, "link", "set", end, "netns", space)
            _ip("-n", switch, "link", "set", f"p{n}", "master", "bridge", "up")
            _ip("-n", space, "addr", "add", f"{address}/24", "dev", end)
            _ip("-n", space, "link", "set", "lo", "up")
            _ip("-n", space, "link", "set", end, "up")

    def start(self, name: str, command: Sequence[str], **options: Any) -> subprocess.Popen[str]:
        """A command on a machine, in a session of its own; `options` are those of Popen."""
        process = subprocess.Popen(
            ["ip", "netns", "exec", self.space(name), *command],
            start_new_session=True, text=True, env=self.environment, **options,
        )  # fmt: skip
        self._running[name].append(process)
        return process

    def keep(self, name: str, process: subprocess.Popen[str]) -> None:
        """A process that ends with those of a machine, though it was not started here."""
        self._running[name].append(process)

    def lose(self, name: str) -> None:
        """Simulates the loss of power of the machine: first its cable is cut, so that its processes end unheard."""
        self.cable(name, up=False)
        self._kill(name)

    def cable(self, name: str, up: bool) -> None:
        """Plugs a machine's cable in, or pulls it out."""
        port = f"p{list(self.addresses).index(name)}"
        _ip("-n", self.space("switch"), "link", "set", port, "up" if up else "down")

    def _kill(self, name: str) -> None:
        """Kills whatever runs in a machine's namespace, by what the kernel says is in it."""
        found = subprocess.run(
            ["ip", "netns", "pids", self.space(name)], capture_output=True, text=True, check=False
        )
        for pid in map(int, found.stdout.split()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for process in self._running[name]:
            process.wait(10)

    def close(self) -> None:
        for name in self.addresses:
            self._kill(name)
        for name in (*self.addresses, "switch"):
            subprocess.run(["ip", "netns", "del", self.space(name)], capture_output=True, check=False)


@contextlib.contextmanager
def machines(addresses: Mapping[str, str], environment: Mapping[str, str]) -> Iterator[Machines]:
    made = Machines(addresses, environment)
    try:
        made.build()
        yield made
    finally:
        made.close()


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"ip {' '.join(arguments)}: {done.stderr.strip()}"


def why_not() -> str | None:
    """The reason why this machine cannot run two namespaces; None if it can."""
    if shutil.which("ip") is None:
        return "there is no command ip (iproute2)"
    space = f"swarm-try-{os.getpid()}"
    tried = subprocess.run(["ip", "netns", "add", space], capture_output=True, text=True, check=False)
    if tried.returncode:
        return f"network namespaces are not permitted: {tried.stderr.strip()}"
    name = f"swt{os.getpid() % 1_000_000}"
    link = ["ip", "-n", space, "link", "add", name, "type", "veth", "peer", "name", f"{name}p"]
    tried = subprocess.run(link, capture_output=True, text=True, check=False)
    subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)
    return f"veth links are not permitted: {tried.stderr.strip()}" if tried.returncode else None
