"""Who asks for one of our topics, but will never hear it: another domain, type, hash or distribution. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from launch_scripts.gateways.ros2.graph import NO_HASH, Endpoint, Kind, SeenEndpoint

_MEETS = {
    Kind.PUBLISHER: Kind.SUBSCRIPTION,
    Kind.SUBSCRIPTION: Kind.PUBLISHER,
    Kind.SERVICE: Kind.CLIENT,
    Kind.CLIENT: Kind.SERVICE,
}
_DOES = {
    Kind.PUBLISHER: "publishes",
    Kind.SUBSCRIPTION: "subscribes to",
    Kind.SERVICE: "serves",
    Kind.CLIENT: "asks",
}
MOST_TOLD = 1000


class PeerWatch:
    """Tells of each peer's fault once.

    counts is bounded: after MOST_TOLD sentences nothing more is told.
    """

    def __init__(self) -> None:
        self._told: set[str] = set()

    def sentence(self, seen: SeenEndpoint, ours: Iterable[Endpoint]) -> str | None:
        """What keeps a peer's endpoint from meeting one of ours of the same name; None if nothing does, or if it
        was told before."""
        said: str | None = None
        for mine in ours:
            if mine.topic != seen.topic or _MEETS[mine.kind] is not seen.kind:
                continue
            why = _why_not(seen, mine)
            if why is None:
                return None
            said = said or why
        if said is None:
            return None
        sentence = f"node {seen.node[:80]} {_DOES[seen.kind]} {seen.topic[:120]} {said}"
        if sentence in self._told or len(self._told) >= MOST_TOLD:
            return None
        self._told.add(sentence)
        return sentence


def _why_not(seen: SeenEndpoint, mine: Endpoint) -> str | None:
    ours = mine.node.domain
    if seen.domain != ours:
        return f"in domain {seen.domain}, and this gateway is in domain {ours} (ROS_DOMAIN_ID, --domain)"
    if seen.type_name != mine.type_name:
        return f"as {seen.type_name[:120]}, and here it is {mine.type_name}"
    if seen.type_hash == mine.type_hash:
        return None
    if NO_HASH in (seen.type_hash, mine.type_hash):
        theirs = "humble" if seen.type_hash == NO_HASH else "a distribution after humble"
        mine_is = "humble" if mine.type_hash == NO_HASH else "a later one"
        return f"as {theirs} does, and this gateway speaks as {mine_is} (--distribution)"
    return (
        f"with another definition of {mine.type_name}: hash {seen.type_hash[:20]}, here {mine.type_hash[:20]} "
        "(--distribution, or a changed message)"
    )
