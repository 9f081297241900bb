"""Places and fixtures of the cell, task types that arms execute at places, and jobs that request them."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import inf, pi
from typing import Literal, NamedTuple, get_args

import numpy as np

from fleet.errors import check_coordinates, listed
from fleet.surface import Surface

Kind = Literal["pick_place", "hold", "press", "sort"]
KINDS: tuple[str, ...] = get_args(Kind)
DWELL_S = 0.5
"""Default of `dwell_s` in scenarios and on the bus: time to close or open the hand."""
PAYLOAD_KG_PER_M3 = 2700.0
"""Density of the ball at the flange that stands for a payload: aluminium."""
MOST_PAYLOAD_M = 0.1
"""Largest radius of that ball."""
LEAST_FIXTURE_M, MOST_FIXTURE_M = 0.001, 10.0
"""Smallest and largest length of a fixture."""
LONGEST_GRASP_S = 180.0
"""Largest `dwell_s` of a pick_place or sort; their standstills are planned sample by sample."""
LONGEST_JOB_S = 7 * 24 * 3600.0
"""Longest planned duration of a job."""


MOST_ALTERNATIVES = 64
"""Most alternative places of one job."""
MOST_FAULTS_OF_ONE_ARM = 2
MOST_FAULTS = 3
"""Faults of one arm, and of all arms together, after which a job is abandoned."""


def reason_to_give_up(arms: Iterable[str]) -> str:
    """Reason for abandoning a job; "" if it is not abandoned.

    Args:
        arms: The arm of each fault in this job.
    """
    faults = Counter(arms)
    if max(faults.values(), default=0) < MOST_FAULTS_OF_ONE_ARM and faults.total() < MOST_FAULTS:
        return ""
    by = ", ".join(f"'{arm}' {times} time{'s' if times > 1 else ''}" for arm, times in sorted(faults.items()))
    return f"Given up, because arms faulted in it: {by}."


class NumberRange(NamedTuple):
    """Smallest and largest allowed value of a number."""

    low: float
    high: float
    unit: str = ""

    def __str__(self) -> str:
        return f"between {self.low:.15g} and {self.high:.15g} {self.unit}".rstrip()


BOUNDS: Mapping[str, NumberRange] = {
    "payload_kg": NumberRange(0.0, 10.0, "kg"),
    "force_n": NumberRange(0.0, 200.0, "N"),
    "dwell_s": NumberRange(0.02, 3600.0, "s"),  # from one sample of a plan; see also `check_dwell`
    "repetitions": NumberRange(1, 100_000),
    "release_s": NumberRange(0.0, 1e9, "s"),
    "due_s": NumberRange(0.0, 1e9, "s"),
    "value": NumberRange(0.0, 1e6),
    "retreat_m": NumberRange(0.0, 1.0, "m"),
    "tool_deg": NumberRange(-360.0, 360.0, "deg"),
}
"""Bounds of every number of a job and a place, in scenarios, on the bus and in Python."""


def check_bounds(owner: object, *fields: str) -> None:
    """Check that these fields, or all elements of a tuple, are within `BOUNDS`; None is allowed.

    Raises:
        ValueError: names the field, the value and the bounds.
    """
    for name in fields:
        given, bounds = getattr(owner, name), BOUNDS[name]
        for value in given if isinstance(given, tuple) else (given,):
            if value is not None and not bounds.low <= value <= bounds.high:
                raise ValueError(f"{type(owner).__name__}.{name} must be {bounds} (got {value}).")


def check_places(owner: object, kind: str, names: Sequence[str]) -> None:
    """Check that a task type has the number of places that it needs, all different.

    Raises:
        ValueError: names the places.
    """
    two = kind in ("pick_place", "sort")
    if len(names) != 1 + two or len(set(names)) != len(names):
        wanted = "two different places, from and to," if two else "one place"
        raise ValueError(f"{type(owner).__name__}.places must be {wanted} for a {kind} (got {listed(names)}).")


def shared_stations(alternatives: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """The stations of the first alternative that all others need, too."""
    first, *others = alternatives
    return tuple(name for name in first if all(name in other for other in others))


def check_alternatives(owner: object, kind: str, alternatives: Sequence[Sequence[str]]) -> None:
    """Check the places of each alternative, and that there are not too many and none twice.

    Raises:
        ValueError: names the places.
    """
    for names in alternatives:
        check_places(owner, kind, names)
    if not 1 <= len(alternatives) <= MOST_ALTERNATIVES:
        raise ValueError(
            f"{type(owner).__name__}.places must have 1 to {MOST_ALTERNATIVES} alternatives (got {len(alternatives)})."
        )
    if len({tuple(names) for names in alternatives}) < len(alternatives):
        raise ValueError(f"{type(owner).__name__}.places must name each alternative once (got {list(alternatives)}).")


def check_dwell(owner: object, kind: str, dwell_s: float) -> None:
    """Check the time in which a task opens or closes the hand.

    Raises:
        ValueError: names the number and what is allowed.
    """
    if kind in ("pick_place", "sort") and dwell_s > LONGEST_GRASP_S:
        raise ValueError(
            f"{type(owner).__name__}.dwell_s of a {kind} must be at most {LONGEST_GRASP_S:g} s, the time to open or "
            f"close the hand (got {dwell_s:g} s). To wait with a payload use a hold."
        )


def check_duration(owner: object, dwell_s: float, repetitions: int) -> None:
    """Check that the dwell times of a job alone do not exceed the longest duration.

    Raises:
        ValueError: names both numbers.
    """
    if dwell_s * repetitions > LONGEST_JOB_S:
        raise ValueError(
            f"{type(owner).__name__}.repetitions times dwell_s must be at most {LONGEST_JOB_S:g} s, 7 days "
            f"(got {repetitions} times {dwell_s:g} s)."
        )


def check_force(owner: object, kind: str, force_n: float) -> None:
    """Check that only a press has a contact force.

    Raises:
        ValueError: names the force and the task type.
    """
    if force_n and kind != "press":
        raise ValueError(
            f"{type(owner).__name__}.force_n must be 0 or left out: only a press has a contact force "
            f"(got {force_n:g} N for a {kind})."
        )


def check_hard_due(owner: object, expires: bool, due_s: float | None) -> None:
    """Check that a job with a hard due date has a due date.

    Raises:
        ValueError: it has none.
    """
    if expires and due_s is None:
        raise ValueError(f"{type(owner).__name__}.due_s is missing: a hard due date needs a time.")


@dataclass(frozen=True, kw_only=True)
class Place:
    """A pose of the hand in the cell; also a station, which one arm at a time may use."""

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
        check_coordinates(self, "position_m")
        check_bounds(self, "tool_deg", "retreat_m")


@dataclass(frozen=True, kw_only=True)
class Fixture:
    """A solid that stands in the cell, for example a table, an oven or a conveyor: a box, or the shape in a file.

    No link of an arm and no payload may touch it. At a place above a table the tool point must therefore be higher
    than the table by the diameter of the heaviest payload, see `payload_radius_m`. Of a file, each connected part
    counts as its convex hull.
    """

    name: str
    position_m: tuple[float, float, float]
    """Centre of a box, or origin of a file, in the world, m."""
    size_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Full lengths along the box's own x, y and z axes, m; not with `mesh`."""
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw about the fixed world axes x, y, z, deg."""
    mesh: str | None = None
    """File of a scenario file's fixture, relative to it: STL, OBJ, GLB, MJCF or URDF. It becomes a `surface`."""
    unit: Literal["m", "mm", "cm", "in"] = "m"
    """Of the coordinates in that file; in: inch."""
    surface: Surface | None = None
    """Of a file that has been read, about the centre of the box around it."""

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("Fixture.name must not be empty.")
        if self.mesh is not None and any(self.size_m):
            raise ValueError(f"Fixture.size_m must be left out beside `mesh` (got {list(self.size_m)}).")
        if self.mesh is None and not all(LEAST_FIXTURE_M <= length <= MOST_FIXTURE_M for length in self.size_m):
            raise ValueError(
                f"Fixture.size_m must be three lengths between {LEAST_FIXTURE_M:g} and {MOST_FIXTURE_M:g} m "
                f"(got {list(self.size_m)})."
            )
        check_coordinates(self, "position_m")
        if not all(abs(angle) <= 360 for angle in self.tilt_deg):
            raise ValueError(f"Fixture.tilt_deg must be between -360 and 360 (got {list(self.tilt_deg)}).")

    @property
    def parts_m(self) -> tuple[np.ndarray, ...]:
        """Corners of each convex part about the centre, m, [corner, 3]: of the box, or of the hulls of a mesh."""
        if self.surface is not None:
            return self.surface.parts_m
        return (np.array(list(product((-0.5, 0.5), repeat=3))) * self.size_m,)


def payload_radius_m(payload_kg: float) -> float:
    """Radius of the ball that stands for a payload, m."""
    return min(MOST_PAYLOAD_M, (3.0 * max(payload_kg, 0.0) / (4.0 * pi * PAYLOAD_KG_PER_M3)) ** (1 / 3))


@dataclass(frozen=True, kw_only=True)
class Work:
    """Motion of the hand in one repetition of a job; the unit of planning."""

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
        check_places(self, self.kind, [place.name for place in self.places])
        check_bounds(self, "payload_kg", "force_n", "dwell_s")
        check_dwell(self, self.kind, self.dwell_s)
        check_force(self, self.kind, self.force_n)

    @cached_property
    def stations(self) -> tuple[str, ...]:
        """Names of the stations it occupies."""
        return tuple(dict.fromkeys(place.name for place in self.places))


@dataclass(frozen=True, kw_only=True)
class Job:
    """A request for a number of repetitions of a task, with release, due date and value."""

    name: str
    work: Work
    repetitions: int
    release_s: float
    due_s: float
    """Soft: a later finish is tardiness, not failure; inf for none."""
    value: float
    after: tuple[str, ...] = ()
    """Names of the jobs that must finish first."""
    expires: bool = False
    """A hard due date: a job that waits then is abandoned, also if an arm has begun and returned it."""
    alternatives: tuple[Work, ...] = ()
    """The same work at other places, any of which serves as well: parallel stations."""

    @cached_property
    def works(self) -> tuple[Work, ...]:
        """The works of which one must be done."""
        return (self.work, *self.alternatives)

    @cached_property
    def stations(self) -> tuple[str, ...]:
        """Names of the stations that each of its works occupies."""
        return shared_stations([work.stations for work in self.works])

    def __post_init__(self) -> None:
        check_bounds(self, "repetitions", "release_s", "value")
        check_duration(self, self.work.dwell_s, self.repetitions)
        if self.due_s != inf:
            check_bounds(self, "due_s")
        if self.due_s < self.release_s:
            raise ValueError(f"Job '{self.name}': needs release_s <= due_s (got {self.release_s}, {self.due_s}).")


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
    import networkx as nx  # slow to import, and the bounds of numbers need it not

    graph = nx.DiGraph(edges)
    if edges and not nx.is_directed_acyclic_graph(graph):
        cycle = " → ".join(edge[0] for edge in nx.find_cycle(graph))
        raise ValueError(f"Jobs must not wait for each other in a cycle: {cycle}.")
