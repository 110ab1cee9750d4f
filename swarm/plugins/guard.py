"""The guard through which a plug-in is called: whatever it does there, its caller gets a checked value.

One that raises, hangs or returns what breaks its contract is out for the rest of the process's life: its fault is
said once, with its name, its kind and the place, and its caller does what `PluginKind.failing` says.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from swarm.errors import SwarmError
from swarm.plugins.deadline import Hangs, call_within
from swarm.plugins.find import Plugin, told

log = logging.getLogger(__name__)

T = TypeVar("T")
Tell = Callable[[str], None]
"""Takes a fault in one sentence."""
_SLOW_SHARE = 0.1
"""A call that takes more than this share of what it may is said to be slow, once."""


class Nonsense(SwarmError):  # noqa: N818
    """A result of a plug-in breaks its contract: the value found, and the value expected."""


class Guard:
    """The single place where one plug-in is called.

    tell   takes its fault
    works  false once it has failed: then it is not called any more
    """

    def __init__(self, plugin: Plugin, tell: Tell) -> None:
        self.works = True
        self._plugin = plugin
        self._tell = tell
        self._slow = False

    def ask(self, call: Callable[[], object], check: Callable[[object], T], otherwise: Callable[[], T]) -> T:
        """Returns the result of `call` after `check`, or of `otherwise` if the plug-in fails or has failed.

        check  raises `Nonsense` on what breaks the contract; what else it raises counts as the plug-in's fault, too
        """
        if not self.works:
            return otherwise()
        kind = self._plugin.named.kind
        began_s = time.monotonic()
        try:
            value = check(call_within(kind.call_s, call))
        except Nonsense as nonsense:
            self._fail(f"returned {nonsense}")
        except Hangs:
            self._fail(f"took more than {kind.call_s:g} s")
        except (Exception, SystemExit) as error:
            self._fail(f"raised {told(error)}")
        else:
            self._watch(time.monotonic() - began_s)
            return value
        return otherwise()

    def _fail(self, what: str) -> None:
        self.works = False
        kind = self._plugin.named.kind
        self._tell(f"{self._plugin} of {self._plugin.named.key}: {kind.method} {what}; {kind.failing}")

    def _watch(self, took_s: float) -> None:
        # In the log only: what a clock says may not change what a simulation sends.
        kind = self._plugin.named.kind
        if not self._slow and took_s > _SLOW_SHARE * kind.call_s:
            self._slow = True
            log.warning(
                "%s: %s took %.2f s; its process does nothing else meanwhile", self._plugin, kind.method, took_s
            )
