"""A hall of any number of arms: rows of up to 16 on the floor, with two stations between every two neighbours."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise

import numpy as np

from fleet.arrivals import Arrivals
from fleet.env.vector import Library
from fleet.job import Place
from scenarios.spec.schema import ArmSpec, JobStream, Scenario, Spread, TwinSpec
from scenarios.suite.instances import layout_of

SHOWN = ("name", "position_m", "tilt_deg", "home")


def hall(
    arms: int, *, hours: float = 1.0, jobs: float | None = None, slots: int = 64, cycles: tuple[int, int] = (5, 15)
) -> Scenario:
    """The scenario of a hall, in which neighbours sort parts between their stations.

    Args:
        jobs: Expected number; default: eight per arm and hour.
        cycles: Fewest and most of a job, of 10 s or so each.
    """
    mounted, horizon_s = layout_of("line", arms, pitch_m=0.8).arms, 3600.0 * hours
    groups = _stations(mounted)
    every_s = horizon_s * len(groups) / (8.0 * arms * hours if jobs is None else jobs)
    streams = [
        JobStream(
            name=f"sort_{i:03d}",
            kind="sort",
            places=tuple(place.name for place in group),
            arrivals=Arrivals(kind="poisson", every_s=every_s),
            payload_kg=(1.0, 2.0),
            repetitions=cycles,
            due_s=1800.0,
        )
        for i, group in enumerate(groups)
    ]
    return Scenario(
        name=f"hall_{arms}",
        description=f"{arms} arms sort parts.",
        horizon_s=horizon_s,
        arms=mounted,
        places=tuple(place for group in groups for place in group),
        jobs=tuple(streams),
        slots=slots,
        spread=Spread(scale=0.5, seed=17),
        twin=TwinSpec(size="quick", exploration=32),
    )


def _stations(arms: Sequence[ArmSpec]) -> list[tuple[Place, Place]]:
    """Two stations before the middle of every two neighbours of a row, each nearer to one of them."""
    middles = [
        ((one.position_m[0] + other.position_m[0]) / 2, one.position_m[1] + 0.4)
        for one, other in pairwise(arms)
        if one.position_m[1] == other.position_m[1]
    ]
    return [
        (Place(name=f"a_{i:02d}", position_m=(round(x - 0.15, 4), y, 0.25)),
         Place(name=f"b_{i:02d}", position_m=(round(x + 0.15, 4), y, 0.25)))
        for i, (x, y) in enumerate(middles)
    ]  # fmt: skip


def toml_of(scenario: Scenario) -> str:
    """The scenario file of a hall."""
    lines = [
        f'description = "{scenario.description}"',
        f"horizon_s = {scenario.horizon_s}",
        f"slots = {scenario.slots}",
    ]
    lines += ["[spread]", f"scale = {scenario.spread.scale}", f"seed = {scenario.spread.seed}"]
    lines += ["[twin]", f'size = "{scenario.twin.size}"', f"exploration = {scenario.twin.exploration}"]
    for arm in scenario.arms:
        lines += ["[[arms]]", *(f"{name} = {json.dumps(getattr(arm, name))}" for name in SHOWN)]
    for place in scenario.places:
        lines += ["[[places]]", f'name = "{place.name}"', f"position_m = {list(place.position_m)}"]
    for stream in scenario.jobs:
        given = asdict(stream)
        lines += ["[[jobs]]", *(f"{n} = {json.dumps(given[n])}" for n in ("name", "kind", "places", "payload_kg"))]
        lines += [f"repetitions = {list(stream.repetitions)}", f"due_s = {stream.due_s}"]
        lines += [f'arrivals = {{ kind = "poisson", every_s = {stream.arrivals.every_s} }}']
    return "\n".join(lines) + "\n"


_PER_ARM = {"law": 1, "modal": 1, "start": 1, "ambient_c": 2, "work": 2, "least": 2}
"""Tables with an axis of arms, and which axis it is."""


def repeated(one: Library, times: int, peers: int = 1) -> Library:
    """Return a fleet several times, without stations or space that arms share; each observes its next few peers."""
    arms = len(one.arms) * times
    tables = one.tables._replace(
        stations=np.zeros_like(one.tables.stations),
        excluded=np.zeros_like(one.tables.excluded),
        **{name: np.concatenate([getattr(one.tables, name)] * times, axis) for name, axis in _PER_ARM.items()},
    )
    near = tuple(tuple((a + n) % arms for n in range(1, peers + 1)) for a in range(arms))  # peers are not read
    return Library(tuple(f"arm_{a}" for a in range(arms)), one.slots, tables, one.draw, near)
