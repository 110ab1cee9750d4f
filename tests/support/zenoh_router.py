"""A router in a process of its own, for sessions of a test."""

import subprocess
import sys

ROUTER = """
import sys
from swarm.config.scenario import NetworkConfig
from swarm.bus.zenoh_bus import open_bus
with open_bus(NetworkConfig(listen=(sys.argv[1],)), mode="router"):
    print("up", flush=True)
    sys.stdin.read()
"""


class Router:
    """A router in a process of its own, to be killed, stalled and started again."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", ROUTER, self.endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"up\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()
