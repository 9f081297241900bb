"""What a picture of the fleet shows: the cell, which stays, and the scene of one moment in it."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fleet.robot import Mount
from fleet.sim import claims
from fleet.sim.claims import Board
from fleet.sim.state import DONE, WAITING, State, World
from fleet.telemetry import WORKING
from fleet.thermal import WINDING

Array = np.ndarray

MountKind = Literal["floor", "wall", "ceiling", "tilted"]
Point = tuple[float, float, float]
"""In the world, m."""
LEVEL_DEG = 10.0
"""A base turned less than this from a floor, wall or ceiling still counts as standing on it."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Who and what stands where; hashable, so that what is drawn once is found again."""

    arms: tuple[str, ...]
    mounts_m: tuple[Point, ...]
    """Base of each arm."""
    kinds: tuple[MountKind, ...]
    """What each arm is fixed to."""
    stations: tuple[tuple[str, Point], ...]
    """Name and tool point; in any order, used or not."""

    def __post_init__(self) -> None:
        if not len(self.arms) == len(self.mounts_m) == len(self.kinds):
            raise ValueError(
                f"Cell needs a mount and a kind per arm (got {len(self.arms)} arms, {len(self.mounts_m)} mounts, "
                f"{len(self.kinds)} kinds)."
            )
        if not self.arms:
            raise ValueError("Cell needs at least one arm.")
        if not all(math.isfinite(x) for point in (*self.mounts_m, *(p for _, p in self.stations)) for x in point):
            raise ValueError("Cell.mounts_m and stations must be finite, in m.")


def mount_kind(mount: Mount) -> MountKind:
    """What an arm is fixed to, by where its base points."""
    up = float(mount.rotation()[2, 2])
    near = math.cos(math.radians(LEVEL_DEG))
    if up > near:
        return "floor"
    if up < -near:
        return "ceiling"
    return "wall" if abs(up) < math.sin(math.radians(LEVEL_DEG)) else "tilted"


def plain_cell(arms: tuple[str, ...], stations: tuple[str, ...]) -> Cell:
    """A cell for a fleet of which nobody knows where it stands: arms in rows, stations in rows beyond them."""
    across = math.ceil(math.sqrt(len(arms)))
    deep = math.ceil(len(arms) / across)
    per_row = max(1, 2 * across)
    return Cell(
        arms=arms,
        mounts_m=tuple((float(i % across), float(-(i // across)), 0.0) for i in range(len(arms))),
        kinds=("floor",) * len(arms),
        stations=tuple(
            (name, ((i % per_row) / 2 - 0.25, -(deep - 0.4) - (i // per_row) / 2, 0.0))
            for i, name in enumerate(stations)
        ),
    )


@dataclass(frozen=True, kw_only=True)
class Offer:
    """A job that waits to be claimed."""

    job: str
    payload_kg: float
    due_in_s: float
    """Time until it is due, negative when late."""
    able: tuple[bool, ...]
    """Which arms can do it at all."""
    free: tuple[bool, ...]
    """Which of them may claim it now."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One moment of a shift."""

    cell: Cell
    time_s: float
    horizon_s: float
    temp_c: Array
    """Motor temperature, [arm, joint]."""
    warning_c: float
    error_c: float
    mode: tuple[int, ...]
    """Index into `fleet.telemetry.MODES`, per arm."""
    job: tuple[str, ...]
    """In hand, per arm; empty for none."""
    share: tuple[float, ...]
    """Of the job in hand that is done, 0 to 1, per arm."""
    at: tuple[tuple[str, ...], ...]
    """Stations each arm occupies."""
    offers: tuple[Offer, ...]
    """In the order of the slots."""
    waiting: int
    """Jobs released and in nobody's hand, on offer or not."""
    finished: int
    faults: int
    title: str = ""

    def __post_init__(self) -> None:
        arms = len(self.cell.arms)
        told = {"temp_c": self.temp_c, "mode": self.mode, "job": self.job, "share": self.share, "at": self.at}
        for name, values in told.items():
            if len(values) != arms:
                raise ValueError(f"Scene.{name} must be of the cell's {arms} arms (got {len(values)}).")
        if not self.warning_c < self.error_c:
            raise ValueError(f"Scene needs warning_c < error_c (got {self.warning_c}, {self.error_c}).")


def scene_of(
    world: World,
    state: State,
    cell: Cell | None = None,
    *,
    env: int = 0,
    board: Board | None = None,
    title: str = "",
) -> Scene:
    """The simulator's truth about one env as a scene.

    Args:
        cell: Where everything stands; a plain one if not given.
        board: `claims.board(world, state)`, if it is at hand.

    Raises:
        ValueError: a cell of other arms.
    """
    cell = cell or plain_cell(world.arms, world.stations)
    if cell.arms != world.arms:
        raise ValueError(f"The cell is of the arms {', '.join(cell.arms)}; the world's are {', '.join(world.arms)}.")
    board = board or claims.board(world, state)
    jobs, mode = world.jobs, state.mode[env]
    time_s = float(state.tick[env] * world.dt_s)
    job = np.where(mode == WORKING, state.job[env], -1).tolist()
    return Scene(
        cell=cell,
        time_s=time_s,
        horizon_s=world.horizon_s,
        temp_c=state.temp_c[env, :, WINDING].copy(),
        warning_c=world.limits.warning_c,
        error_c=world.limits.error_c,
        mode=tuple(mode.tolist()),
        job=tuple(jobs.names[env][j] if j >= 0 else "" for j in job),
        share=tuple(_share(world, state, env, a, j) for a, j in enumerate(job)),
        at=tuple(_stations(world, env, j) for j in job),
        offers=tuple(_offer(world, board, env, s, time_s) for s in np.flatnonzero(board.on_offer[env] >= 0).tolist()),
        waiting=int((jobs.exists[env] & (state.status[env] == WAITING) & (jobs.release_s[env] <= time_s)).sum()),
        finished=int((jobs.exists[env] & (state.status[env] == DONE)).sum()),
        faults=int(state.faults[env].sum()),
        title=title,
    )


def _share(world: World, state: State, env: int, arm: int, job: int) -> float:
    if job < 0:
        return 0.0
    approach, cycle, retreat = world.plans.times_s[world.offers.plan[env, arm, job]].tolist()
    whole = approach + int(state.todo[env, arm]) * cycle + retreat
    return min(1.0, float(state.progress_s[env, arm]) / whole) if whole > 0 else 0.0


def _stations(world: World, env: int, job: int) -> tuple[str, ...]:
    return tuple(world.stations[s] for s in world.jobs.stations[env, job].tolist() if s >= 0) if job >= 0 else ()


def _offer(world: World, board: Board, env: int, slot: int, time_s: float) -> Offer:
    jobs, job = world.jobs, int(board.on_offer[env, slot])
    return Offer(
        job=jobs.names[env][job],
        payload_kg=float(jobs.payload_kg[env, job]),
        due_in_s=float(jobs.due_s[env, job]) - time_s,
        able=tuple((world.offers.plan[env, :, job] >= 0).tolist()),
        free=tuple(board.mask[env, :, slot + 1].tolist()),
    )
