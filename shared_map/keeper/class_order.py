"""Which class of vehicles each number means, by which the marks in a store name it. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence


def agreed(stored: Sequence[str], given: Sequence[str], used: Collection[int]) -> list[str] | str:
    """The classes in the order of their numbers, once a run with these has the store; why it cannot have it, in
    words, where a mark for one class alone would become one for another, or for nobody though the class is there.

    stored  the classes as the store has them; it may lack some of `used` if it is older than they
    given   those of the run
    used    numbers, from 1 on, of the classes for which alone something is marked
    """
    for number in sorted(used):
        if number > len(stored):
            continue
        name = stored[number - 1]
        is_gone = number > len(given) and name not in given
        if not is_gone and given[number - 1 : number] != [name]:
            there = ", ".join(given) if given else "none"
            return f"marks for {name} alone, which is class {number} there, but this run has the classes {there}"
    return [*given, *stored[len(given) :]]
