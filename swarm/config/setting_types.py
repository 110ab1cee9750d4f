"""Types of settings: their ranges, and the words that they may be."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from swarm.config.explain import check_keywords
from swarm.peers import HIGHEST_RANK

Positive = Annotated[float, Meta(gt=0, le=1e12)]
NotNegative = Annotated[float, Meta(ge=0, le=1e12)]
Count = Annotated[int, Meta(ge=1, le=100_000)]
Standbys = Annotated[int, Meta(ge=0, le=HIGHEST_RANK)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,40}\Z")]
GroupName = Annotated[str, Meta(pattern=r"^(\*|[A-Za-z0-9_][A-Za-z0-9_.-]{0,40})\Z")]
ProcessName = Annotated[str, Meta(pattern=r"^[a-z]+\.[A-Za-z0-9_.-]{1,56}\Z")]
CommonName = Annotated[str, Meta(pattern=r"^[a-z]+\.[A-Za-z0-9_.-]{1,56}(~[0-9]{1,4})?\Z")]
Metres = Annotated[float, Meta(ge=-1e12, le=1e12)]
Point = tuple[Metres, Metres]
Polygon = Annotated[tuple[Point, ...], Meta(min_length=3, max_length=10_000)]
PlaceText = str
"""A place as `swarm.places` reads it. No `Meta`: msgspec 0.22 crashes on a union of a bounded text and a pair."""

RESERVED_GROUP = "operator"
"""No group is called so: zones are marks of this one, which every group hears."""
RESERVED_GROUPS = {
    RESERVED_GROUP: "zones of operators are marks of that name",
    "keeper": "digests of keepers have that name",
}
"""Groups that there are not, as an author's name begins with its group: name -> reason."""
MOST_PER_AGENT = 1000
"""Vehicles of one agent process."""
MOST_TARGETS = 1000
"""Limit for all entries together."""

Preset = Literal["hiker", "wheeled", "tracked", "quadruped"]

Slope = Annotated[float, Meta(gt=-90, lt=90)]
SlopeFactor = Annotated[float, Meta(ge=0.01, le=100)]
SpeedOnGround = Annotated[float, Meta(ge=0.01, le=340)]
"""m/s; what a map can tell of a cell (`swarm.wire.messages.map_data.PACE_LEAST` and `PACE_MOST`)."""


def plugin_name(built_in: Any = None) -> Meta:
    """Names of one kind: those that are built in, and those of plug-ins (`swarm.plugins`)."""
    names = list(get_args(built_in))
    return Meta(
        pattern=r"^[\w.+-]{1,100}(:[\w.]{1,100})?\Z",
        extra={"built_in": names},
        extra_json_schema={"examples": [*names, "module:Name"]},
    )


Options = dict[str, Any]
"""Options of a plug-in, which its own struct checks."""

ClassName = Literal[
    "unknown", "water", "forest", "rock", "grass", "soil", "road", "built", "snow", "shrub", "wetland"
]

CoverGround = Literal[ClassName, "lethal"] | Positive
"""Meaning of a code of a land-cover map: a class, or a pace relative to open ground."""

CoverCode = Annotated[str, Meta(pattern=r"^[0-9]{1,5}\Z")]

ElevationEncoding = Literal["metres"]


class SectionType(msgspec.StructMeta):
    """Sections which, made in Python, say of an unknown keyword what they say of it in a file."""

    def __call__(self, *args: Any, **settings: Any) -> Any:
        check_keywords(settings, self.__struct_fields__, self.__name__)
        return super().__call__(*args, **settings)


class Section(msgspec.Struct, metaclass=SectionType, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the sections of a scenario."""
