"""Places and fixtures of the cell, works that arms do at the places, and jobs that request works."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import Literal, get_args

import networkx as nx

from fleet.errors import check_nonnegative, check_positive

Kind = Literal["pick_place", "hold", "press", "sort"]
KINDS: tuple[str, ...] = get_args(Kind)
DWELL_S = 0.5
"""Default of `dwell_s` in scenarios and on the bus: time to close or open the hand."""
PAYLOAD_KG_PER_M3 = 2700.0
"""A payload counts as a ball of this density, aluminium's, that hangs from the flange."""
MOST_PAYLOAD_M = 0.1
"""Largest radius of such a ball."""
LEAST_FIXTURE_M, MOST_FIXTURE_M = 0.001, 10.0
"""Smallest and largest length of a fixture."""
FARTHEST_M = 100.0
"""Largest coordinate of a fixture."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """A pose in the cell at which a hand works; also a station, which one arm at a time may use."""

    name: str
    position_m: tuple[float, float, float]
    """Tool point in the world, m."""
    tool_deg: tuple[float, float, float] = (180.0, 0.0, 0.0)
    """Roll, pitch, yaw of the tool frame about the fixed world axes, deg; its z axis points out of the hand.
    (180, 0, 0) points down, (0, 90, 0) along world x."""
    retreat_m: float = 0.08
    """Distance that the hand retracts along its own z axis before it moves on."""

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("Place.name must not be empty.")
        check_nonnegative(self, "retreat_m")


@dataclass(frozen=True, kw_only=True)
class Fixture:
    """A solid box that stands in the cell, for example a table, an oven or a conveyor.

    No link of an arm and no payload may touch it. At a place above a table the tool point must therefore be higher
    than the table by the diameter of the heaviest payload, see `payload_radius_m`.
    """

    name: str
    position_m: tuple[float, float, float]
    """Centre in the world, m."""
    size_m: tuple[float, float, float]
    """Full lengths along the box's own x, y and z axes, m."""
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw about the fixed world axes x, y, z, deg."""

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("Fixture.name must not be empty.")
        if not all(LEAST_FIXTURE_M <= length <= MOST_FIXTURE_M for length in self.size_m):
            raise ValueError(
                f"Fixture.size_m must be three lengths between {LEAST_FIXTURE_M:g} and {MOST_FIXTURE_M:g} m "
                f"(got {list(self.size_m)})."
            )
        if not all(abs(x) <= FARTHEST_M for x in self.position_m):
            raise ValueError(
                f"Fixture.position_m must be between -{FARTHEST_M:g} and {FARTHEST_M:g} m "
                f"(got {list(self.position_m)})."
            )
        if not all(abs(angle) <= 360 for angle in self.tilt_deg):
            raise ValueError(f"Fixture.tilt_deg must be between -360 and 360 (got {list(self.tilt_deg)}).")


def payload_radius_m(payload_kg: float) -> float:
    """Radius of the ball that a payload counts as, m."""
    return min(MOST_PAYLOAD_M, (3.0 * max(payload_kg, 0.0) / (4.0 * pi * PAYLOAD_KG_PER_M3)) ** (1 / 3))


@dataclass(frozen=True, kw_only=True)
class Work:
    """What the hand does in one repetition of a job; plans are made for it."""

    kind: Kind
    places: tuple[Place, ...]
    """pick_place, sort: from, to. hold, press: one place."""
    payload_kg: float = 0.0
    """Carried from grasp to release; a hold grasps and releases at its place."""
    dwell_s: float = DWELL_S
    """pick_place, sort: time to close or open the hand. hold, press: duration of one repetition."""
    force_n: float = 0.0
    """press: contact force along the tool's z axis, N."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"Work.kind '{self.kind}' is unknown. Allowed: {', '.join(KINDS)}.")
        wanted = 2 if self.kind in ("pick_place", "sort") else 1
        if len(self.places) != wanted:
            raise ValueError(f"A {self.kind} needs {wanted} place(s), got {len(self.places)}.")
        check_nonnegative(self, "payload_kg", "force_n")
        check_positive(self, "dwell_s")
        if self.force_n and self.kind != "press":
            raise ValueError(f"Only a press has a contact force; this is a {self.kind} with {self.force_n} N.")

    @cached_property
    def stations(self) -> tuple[str, ...]:
        """Names of the stations it occupies."""
        return tuple(dict.fromkeys(place.name for place in self.places))


@dataclass(frozen=True, kw_only=True)
class Job:
    """A request for a number of repetitions of a work, with release, due date and value."""

    name: str
    work: Work
    repetitions: int
    release_s: float
    due_s: float
    """Soft: a later finish is tardiness, not failure."""
    value: float
    after: tuple[str, ...] = ()
    """Names of the jobs that must finish first."""

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise ValueError(f"Job '{self.name}': repetitions must be >= 1 (got {self.repetitions}).")
        if self.release_s < 0 or self.due_s < self.release_s:
            raise ValueError(f"Job '{self.name}': needs 0 <= release_s <= due_s (got {self.release_s}, {self.due_s}).")


def check_precedence(jobs: Sequence[Job]) -> None:
    """Check that the jobs can be done in some order.

    Raises:
        ValueError: two jobs have one name, a predecessor does not exist, or the precedence has a cycle.
    """
    names: set[str] = set()
    for job in jobs:
        if job.name in names:
            raise ValueError(f"Names of jobs must be unique; given more than once: {job.name}.")
        names.add(job.name)
    edges = [(before, job.name) for job in jobs for before in job.after]
    for before, name in edges:
        if before not in names:
            raise ValueError(f"Job '{name}' waits for '{before}', which does not exist.")
    graph = nx.DiGraph(edges)
    if edges and not nx.is_directed_acyclic_graph(graph):
        cycle = " → ".join(edge[0] for edge in nx.find_cycle(graph))
        raise ValueError(f"Jobs must not wait for each other in a cycle: {cycle}.")
