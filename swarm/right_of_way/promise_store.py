"""The file of an agent for right of way: its own generations, and its promises and tables as a member."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import msgspec

from swarm.config.input_files import FileKind
from swarm.config.revocations import with_revocations
from swarm.config.scenario import NetworkConfig
from swarm.errors import ConfigError, DamagedError
from swarm.journal import Journal
from swarm.recording.service_boundary import ExternalCalls
from swarm.right_of_way.agent_core import OwnRecord
from swarm.wire.messages.traffic import Table

_SIZE_BYTES = 1 << 18
"""Size of the file at first."""


class _Record(msgspec.Struct, array_like=True):
    """One line of the file: either the agent's own record, or what it promised and stored of a shard."""

    own: OwnRecord | None = None
    promised: int = 0
    table: Table | None = None


_decode = msgspec.msgpack.Decoder(_Record).decode

PROMISE_STORE = ExternalCalls(
    "store",
    calls={"reserve": str | None, "revoked": list[str], "save_own": None, "save": None, "sync": None},
    facts={"own": OwnRecord, "saved": dict[int, tuple[int, Table]], "ready": bool},
)
"""Calls of its store that an agent uses."""


class PromiseStore:
    """Records of an agent, here in memory only: they survive a simulated process, not this one.

    own    of the agent itself
    saved  shard -> (promised epoch, stored table)
    """

    def __init__(self, disk: int) -> None:
        self.own = OwnRecord(disk=disk)
        self.saved: dict[int, tuple[int, Table]] = {}

    @property
    def ready(self) -> bool:
        """True if there is space for one event's records; if not, nothing may be promised."""
        return True

    def reserve(self) -> str | None:
        """Tries to get the space that is missing. Returns why it cannot."""
        return None

    def revoked(self) -> list[str]:
        """Returns the revoked names in certificates that are known on this machine."""
        return []

    def save_own(self, own: OwnRecord) -> None:
        self.own = own

    def save(self, promised: int, table: Table) -> None:
        self.saved[table.shard] = (promised, table)

    def sync(self) -> None:
        """Returns once all that was saved is on the disk. Until then nothing may be said that rests on it."""


class FilePromiseStore(PromiseStore):
    """A journal of promises. Records before a `sync` survive a kill and a loss of power.

    waits    for the end of a process that has locked it
    network  names the certificate; the revocation list lies beside it

    Raises StoreError if the file is in use, is damaged or cannot be written.
    """

    def __init__(self, path: Path, *, waits: bool = False, network: NetworkConfig | None = None) -> None:
        super().__init__(secrets.randbits(60))
        self._network = network or NetworkConfig()
        self._encode = msgspec.msgpack.Encoder().encode
        in_use = "by the same agent, which runs here already: end it first"
        self._journal = Journal(path, FileKind.PROMISES, self._live, size=_SIZE_BYTES, in_use=in_use, waits=waits)
        try:
            for body in self._journal.found:
                record = _decode(body)
                if record.own is not None:
                    self.own = record.own
                elif record.table is not None:
                    self.saved[record.table.shard] = (record.promised, record.table)
        except msgspec.MsgspecError as error:
            self.close()
            raise DamagedError(f"{path}: expected an agent's promises, found other records: {error}") from error
        self._journal.begin()

    @property
    def ready(self) -> bool:
        return self._journal.ready

    def reserve(self) -> str | None:
        return self._journal.reserve()

    def revoked(self) -> list[str]:
        with suppress(ConfigError):  # the router says so, and keeps the names from before
            self._network = with_revocations(self._network)
        return list(self._network.revoked)

    def save_own(self, own: OwnRecord) -> None:
        super().save_own(own)
        self._journal.append(self._encode(_Record(own=own)))

    def save(self, promised: int, table: Table) -> None:
        super().save(promised, table)
        self._journal.append(self._encode(_Record(promised=promised, table=table)))

    def sync(self) -> None:
        self._journal.sync()

    def close(self) -> None:
        self._journal.close()

    def _live(self) -> Iterator[bytes]:
        yield self._encode(_Record(own=self.own))
        for promised, table in self.saved.values():
            yield self._encode(_Record(promised=promised, table=table))
