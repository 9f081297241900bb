"""A job as messages describe it."""

from typing import Annotated

import msgspec

from fleet.bus.protocol.messages import Name
from fleet.errors import check_names
from fleet.job import BOUNDS, DWELL_S, Kind, check_bounds, check_duration, check_dwell, check_places


def _bounds(name: str) -> msgspec.Meta:
    """Bounds of a number in the JSON schema; `JobSpec` itself checks them, as its error also names the value."""
    return msgspec.Meta(extra_json_schema={"minimum": BOUNDS[name].low, "maximum": BOUNDS[name].high})


class JobSpec(msgspec.Struct, frozen=True, omit_defaults=True):
    """A job on the bus; fields as in `fleet.job.Work` and `fleet.job.Job`."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
    """Unique in the fleet; a second job with this name is the same job."""
    kind: Kind
    """What an arm does in a cycle, as in [CellKind](#cellkind)."""
    places: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=2)]
    """Places of the cell: from and to for pick_place and sort; one for hold and press."""
    repetitions: Annotated[int, _bounds("repetitions")] = 1
    """Cycles of the job."""
    payload_kg: Annotated[float, _bounds("payload_kg")] = 0.0
    dwell_s: Annotated[float, _bounds("dwell_s")] = DWELL_S
    force_n: Annotated[float, _bounds("force_n")] = 0.0
    release_s: Annotated[float, _bounds("release_s")] = 0.0
    """Earliest start, fleet time."""
    due_s: Annotated[float, _bounds("due_s")] | None = None
    """Due date, fleet time, not before `release_s`; null for none."""
    value: Annotated[float, _bounds("value")] = 1.0
    """What finishing it is worth, in any unit that all jobs share."""
    after: tuple[Name, ...] = ()
    """Jobs that must be finished before."""
    expires: bool = False
    """The due date is hard: the job is given up if it still waits then."""

    def __post_init__(self) -> None:
        check_names(self, "name", "places", "after")
        check_places(self, self.kind, self.places)
        check_bounds(self, "repetitions", "payload_kg", "dwell_s", "force_n", "release_s", "due_s", "value")
        check_dwell(self, self.kind, self.dwell_s)
        check_duration(self, self.dwell_s, self.repetitions)
        if self.due_s is not None and self.due_s < self.release_s:
            raise ValueError(f"JobSpec.due_s must be >= release_s = {self.release_s:g} (got {self.due_s:g}).")
