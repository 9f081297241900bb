"""Messages that describe a cell, so that a client can write jobs for it."""

from typing import Annotated

import msgspec

from fleet.bus.protocol.messages import Count, Name, Number
from fleet.job import Kind

Point = Annotated[tuple[Number, ...], msgspec.Meta(min_length=3, max_length=3)]


class CellRequest(msgspec.Struct, frozen=True):
    """Request to `jobs/cell`: the places, arms and limits of the cell."""


class CellPlace(msgspec.Struct, frozen=True):
    """A station that a job may name; one arm at a time works there."""

    name: Name
    position_m: Point
    """Tool point in the world, m."""
    tool_deg: Point
    """Roll, pitch, yaw of the tool frame about the fixed world axes, deg; its z axis points out of the hand."""
    retreat_m: Number
    """Distance that the hand retracts along its own z axis before it moves on."""


class CellFixture(msgspec.Struct, frozen=True):
    """A solid that stands in the cell, by the box around it; no arm may touch it."""

    name: Name
    position_m: Point
    """Its centre in the world, m."""
    size_m: Point
    """Full edge lengths along its own axes, m."""
    tilt_deg: Point
    """Roll, pitch, yaw of the box, deg."""


class CellKind(msgspec.Struct, frozen=True):
    """A task type."""

    kind: Kind
    places: Count
    """Number of stations in a job of this type: 2 are from and to."""
    meaning: str
    """One cycle in words."""


class Limit(msgspec.Struct, frozen=True):
    """Smallest and largest value of a field of `JobSpec`, both allowed."""

    low: Number
    high: Number
    unit: str = ""


class PlannedWork(msgspec.Struct, frozen=True):
    """A task for which an arm has plans. Another payload, dwell or force makes another task, which is planned on
    request."""

    kind: Kind
    places: tuple[Name, ...]
    payload_kg: Number
    plans: Count
    """Number of plans. Infeasible tasks are left out."""
    cycle_s: Number | None = None
    """Duration of a cycle by the fastest plan, with this `dwell_s`."""
    dwell_s: Number = 0.0
    force_n: Number = 0.0
    """As in `JobSpec`, and `dwell_s` too."""


class CellArm(msgspec.Struct, frozen=True):
    """An arm of the cell."""

    name: Name
    position_m: Point
    """Base in the world, m."""
    tilt_deg: Point
    """Roll, pitch, yaw of the base, deg."""
    payload_kg: Number
    """Largest payload within half its reach, without time limit: the rating less the gripper, or a lower limit of this
    arm."""
    payload_outstretched_kg: Number
    """The same at its full reach."""
    reach_m: Number
    """From joint 2 to the tool point."""
    works: tuple[PlannedWork, ...] = ()
    """Tasks of the scenario; empty if the message would be too large. A dry run (`arm/*/quote`) covers any job."""


class Cell(msgspec.Struct, frozen=True):
    """Reply to a `CellRequest`."""

    auctioneer: Name
    scenario: str
    places: tuple[CellPlace, ...]
    arms: tuple[CellArm, ...]
    kinds: tuple[CellKind, ...]
    limits: dict[Name, Limit]
    """By field of `JobSpec`."""
    warning_c: Number
    """Motor temperature of zero headroom, °C."""
    error_c: Number
    """Motor temperature at which an arm faults, °C."""
    jobs_in_message: Annotated[int, msgspec.Meta(ge=1)]
    """Maximum number of jobs in one `Submission`."""
    fixtures: tuple[CellFixture, ...] = ()
