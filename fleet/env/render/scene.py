"""What a picture of the fleet shows: the fixed cell, and one moment of a shift in it."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fleet.engine.shift import open_jobs
from fleet.engine.state import DONE, WAITING, State
from fleet.engine.world import World
from fleet.heat.thermal import WINDING
from fleet.job import Fixture
from fleet.robot import Mount
from fleet.telemetry import WORKING

Array = np.ndarray

MountKind = Literal["floor", "wall", "ceiling", "tilted"]

Point = tuple[float, float, float]
"""World coordinates, m."""

LEVEL_DEG = 10.0
"""Largest tilt of a base that counts as level, upright or upside down."""


@dataclass(frozen=True, kw_only=True)
class CellMap:
    """Positions of arms, stations and fixtures; hashable."""

    arms: tuple[str, ...]
    mounts_m: tuple[Point, ...]
    """Base of each arm."""
    kinds: tuple[MountKind, ...]
    """Mount of each arm."""
    stations: tuple[tuple[str, Point], ...]
    """Name and tool point of each station."""
    fixtures: tuple[Fixture, ...] = ()


def mount_kind(mount: Mount) -> MountKind:
    """Mount of an arm, from the direction of its base."""
    up = float(mount.rotation()[2, 2])
    level = math.cos(math.radians(LEVEL_DEG))
    if abs(up) > level:
        return "floor" if up > 0 else "ceiling"
    return "wall" if abs(up) < math.sin(math.radians(LEVEL_DEG)) else "tilted"


def grid_cell(arms: tuple[str, ...], stations: tuple[str, ...]) -> CellMap:
    """A cell for a fleet of unknown positions: arms in rows, stations in rows in front of them."""
    across = math.ceil(math.sqrt(len(arms)))
    front = 0.4 - math.ceil(len(arms) / across)
    return CellMap(
        arms=arms,
        mounts_m=tuple((float(i % across), float(-(i // across)), 0.0) for i in range(len(arms))),
        kinds=("floor",) * len(arms),
        stations=tuple(
            (name, ((i % (2 * across)) / 2 - 0.25, front - (i // (2 * across)) / 2, 0.0))
            for i, name in enumerate(stations)
        ),
    )


@dataclass(frozen=True, kw_only=True)
class QueuedJob:
    """A job in a slot."""

    job: str
    payload_kg: float
    due_in_s: float
    """Time left until it is due; negative when late."""
    able: tuple[bool, ...]
    """Arms that have a plan for it."""
    free: tuple[bool, ...]
    """Arms that may claim it now."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One moment of a shift."""

    cell: CellMap
    time_s: float
    horizon_s: float
    temp_c: Array
    """Motor temperature, [arm, joint]."""
    warning_c: float
    error_c: float
    mode: tuple[int, ...]
    """Index into `fleet.telemetry.MODES`, per arm."""
    job: tuple[str, ...]
    """Current job per arm, empty for none."""
    progress: tuple[float, ...]
    """Finished share of the current job, 0 to 1, per arm."""
    at: tuple[tuple[str, ...], ...]
    """Stations each arm occupies."""
    queue: tuple[QueuedJob, ...]
    """Jobs in the slots, in their order."""
    waiting: int
    """Number of released jobs that no arm works on, with or without a slot."""
    finished: int
    faults: int
    title: str = ""


def scene_of(world: World, state: State, cell: CellMap | None = None) -> Scene:
    """Scene of env 0 from the simulator's state.

    Args:
        cell: Positions of arms and stations; `grid_cell` if not given.

    Raises:
        ValueError: the cell has other arms than the world.
    """
    cell = cell or grid_cell(world.arms, world.stations)
    if cell.arms != world.arms:
        raise ValueError(f"The cell has the arms {', '.join(cell.arms)}; the world has {', '.join(world.arms)}.")
    slot_job, mask = open_jobs(world, state)
    shift, mode = world.shifts[0], state.mode[0]
    kinds = [world.kinds[kind] for kind in shift.kind.tolist()]
    time_s = float(state.tick[0] * world.dt_s)
    status, released = state.status[0, : len(kinds)], shift.release_s <= time_s
    current = np.where(mode == WORKING, state.job[0], -1).tolist()
    on_offer, options = slot_job[0].tolist(), world.plans_per_job
    return Scene(
        cell=cell,
        time_s=time_s,
        horizon_s=world.horizon_s,
        temp_c=state.temp_c[0, :, WINDING].copy(),
        warning_c=world.tables.warning_c,
        error_c=world.tables.error_c,
        mode=tuple(mode.tolist()),
        job=tuple(shift.names[j] if j >= 0 else "" for j in current),
        progress=tuple(_progress(world, state, a, j) for a, j in enumerate(current)),
        at=tuple(kinds[j].stations if j >= 0 else () for j in current),
        queue=tuple(
            QueuedJob(
                job=shift.names[j],
                payload_kg=kinds[j].work.payload_kg,
                due_in_s=float(shift.due_s[j]) - time_s,
                able=tuple(np.any(world.tables.work["plan"][0, shift.kind[j]] >= 0, axis=-1).tolist()),
                free=tuple(np.any(mask[0, :, 1 + slot * options :][:, :options], axis=-1).tolist()),
            )
            for slot, j in enumerate(on_offer)
            if j >= 0
        ),
        waiting=int(((status == WAITING) & released).sum()),
        finished=int((status == DONE).sum()),
        faults=int(state.faults[0].sum()),
    )


def _progress(world: World, state: State, arm: int, job: int) -> float:
    """Finished share of the job of an arm; 0 for no job, -1."""
    if job < 0:
        return 0.0
    approach, cycle, retreat = world.tables.plans["times_s"][state.plan[0, arm]].tolist()
    whole_s = approach + int(state.todo[0, arm]) * cycle + retreat
    return min(1.0, float(state.progress_s[0, arm]) / whole_s) if whole_s > 0 else 0.0
