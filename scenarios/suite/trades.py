"""Job mixes of real trades: the tasks that arrive at every group of stations.

Engineering estimates of masses, forces and times, within the rating of the Gen3.
"""

from dataclasses import dataclass
from typing import Literal

from fleet.job import DWELL_S, Kind

TradeName = Literal[
    "machine_tending", "palletising", "screwdriving", "gluing", "polishing", "kitting", "inspection", "assembly"
]
Letter = Literal["a", "b", "c"]


@dataclass(frozen=True, kw_only=True)
class Task:
    """One kind of job at a group of stations."""

    name: str
    kind: Kind
    at: tuple[Letter, ...]
    """Stations of the group; c is b where a group has two."""
    payload_kg: tuple[float, ...] = (0.0,)
    repetitions: tuple[int, int]
    dwell_s: float = DWELL_S
    force_n: float = 0.0
    value: float
    due_s: float
    heats: bool = False
    """Whether it is one of the tasks that load a few joints for long: their share grows with the heat severity."""
    after: str = ""
    """With precedence, the task whose job of the same number must finish first."""


def _hold(name: str, at: Letter, kg: tuple[float, ...], minutes: tuple[int, int], after: str = "") -> Task:
    return Task(
        name=name, kind="hold", at=(at,), payload_kg=kg, repetitions=minutes, dwell_s=60.0, value=4.0, due_s=2400.0,
        heats=True, after=after,
    )  # fmt: skip


def _press(name: str, at: Letter, force_n: float, dwell_s: float, times: tuple[int, int], after: str = "") -> Task:
    return Task(
        name=name, kind="press", at=(at,), repetitions=times, dwell_s=dwell_s, force_n=force_n, value=3.0,
        due_s=1800.0, heats=True, after=after,
    )  # fmt: skip


def _move(
    name: str, at: tuple[Letter, Letter], kg: tuple[float, ...], times: tuple[int, int], after: str = "",
    *, heats: bool = False, value: float = 2.0,
) -> Task:  # fmt: skip
    return Task(
        name=name, kind="pick_place", at=at, payload_kg=kg, repetitions=times, value=value, due_s=1500.0, heats=heats,
        after=after,
    )  # fmt: skip


def _sort(name: str, at: tuple[Letter, Letter], kg: tuple[float, ...], times: tuple[int, int], after: str = "") -> Task:
    return Task(
        name=name, kind="sort", at=at, payload_kg=kg, repetitions=times, dwell_s=0.2, value=1.0, due_s=1200.0,
        after=after,
    )  # fmt: skip


TRADES: dict[TradeName, tuple[Task, ...]] = {
    "machine_tending": (
        _move("load", ("a", "b"), (1.0, 2.0), (15, 40)),
        _hold("steady", "c", (2.0,), (6, 14), "load"),
        _move("unload", ("b", "a"), (1.0,), (15, 40), "load"),
    ),
    "palletising": (
        _sort("feed", ("b", "a"), (0.3,), (40, 120)),
        _move("stack", ("a", "b"), (2.0, 3.0), (40, 100), "feed", heats=True, value=3.0),
        _hold("hold_sheet", "c", (2.0,), (5, 12), "stack"),
    ),
    "screwdriving": (
        _move("place", ("a", "b"), (0.5,), (15, 40)),
        _press("screw_a", "a", 80.0, 15.0, (20, 50), "place"),
        _press("screw_b", "b", 80.0, 15.0, (20, 50), "place"),
    ),
    "gluing": (
        _move("lay_out", ("a", "b"), (1.0,), (15, 40)),
        _hold("glue_a", "a", (2.0, 3.0), (8, 18), "lay_out"),
        _hold("glue_c", "c", (2.0,), (8, 18), "lay_out"),
    ),
    "polishing": (
        _move("load", ("b", "a"), (1.0,), (15, 40)),
        _press("polish_a", "a", 90.0, 20.0, (15, 40), "load"),
        _press("polish_c", "c", 80.0, 20.0, (15, 40), "load"),
    ),
    "kitting": (
        _sort("pick_small", ("a", "b"), (0.2,), (30, 90)),
        _move("pick_large", ("b", "a"), (1.0, 2.0), (15, 50)),
        _hold("hold_tray", "c", (1.5,), (6, 14), "pick_small"),
    ),
    "inspection": (
        _hold("show_a", "a", (1.0, 3.0), (6, 15)),
        _hold("show_b", "b", (2.0,), (6, 15)),
        _sort("sort_out", ("a", "b"), (0.3,), (30, 90), "show_a"),
    ),
    "assembly": (
        _move("feed", ("a", "b"), (1.0,), (15, 40)),
        _hold("hold_part", "c", (2.0,), (6, 14), "feed"),
        _press("join", "a", 80.0, 20.0, (8, 25), "hold_part"),
    ),
}
