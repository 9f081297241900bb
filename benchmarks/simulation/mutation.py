"""A rule of the product that is broken on purpose, by a patch of the running process.

A patch replaces methods of the product's classes until the end of its `with` block. The simulation must find each one.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from fleet.live.auction.records import Checked

Patch = tuple[Any, str, Callable[[Any], Any]]
"""Where, the name, and what makes the replacement of what was there."""


class Mutation(NamedTuple):
    """A broken rule."""

    rule: str
    patches: tuple[Patch, ...]
    alone: bool | None = None
    """Whether it concerns fleets without an auctioneer; None: all fleets."""


MUTATIONS: dict[str, Mutation] = {}
"""By name."""


def add_mutation(name: str, rule: str, *patches: Patch, alone: bool | None = None) -> None:
    MUTATIONS[name] = Mutation(rule, patches, alone)


@contextmanager
def applied(name: str) -> Iterator[None]:
    """Break one rule until the end of the block; "" breaks none."""
    before: list[tuple[Any, str, Any]] = []
    try:
        for owner, attribute, make in MUTATIONS[name].patches if name else ():
            original = vars(owner)[attribute]
            before.append((owner, attribute, original))
            setattr(owner, attribute, make(original))
        yield
    finally:
        for owner, attribute, original in reversed(before):
            setattr(owner, attribute, original)


def unwritten(kind: type) -> Callable[[Any], Any]:
    """Journal whose records of one kind are not written, nor the checks that would notice it."""

    def make(append: Any) -> Any:
        def patched(self: Any, *records: Any) -> None:
            append(self, *(record for record in records if not isinstance(record, kind | Checked)))

        return patched

    return make
