"""The exchange: broadcasts of every arm at a step, and what every arm then knows of every other.

`MemoryExchange` is the one implementation; `ZenohExchange` also publishes the messages of each step on the bus.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from fleet.telemetry import MODES

Array = np.ndarray

UNHEARD = -1
"""Mode of an arm without a received broadcast."""


@dataclass(frozen=True, eq=False)
class Broadcast:
    """Broadcasts of every arm at one step."""

    time_s: float
    mode: Array
    """int, [arm]: 0 idle, 1 working, 2 faulted."""
    temp_c: Array
    """Measured motor temperatures, [arm, joint]."""
    headroom_k: Array
    """Warning limit minus hottest motor, [arm]."""
    busy_s: Array
    """Time until home with the current job done, [arm]."""
    jobs: tuple[str, ...]
    """Names of the open jobs, [slot]; "" for an empty slot, which is not broadcast."""
    difficulty: Array
    """[arm, slot], NaN where the arm has no score or cannot do the job."""
    p_saturation: Array
    """[arm, slot], NaN where unknown."""
    twin: tuple[str, ...]
    """Twin version per arm."""


@dataclass(frozen=True, eq=False)
class PeerView:
    """What every arm knows of every arm after a step, [receiver, sender, ...]; of itself, its own broadcast.

    Do not write to the arrays: receivers with the same knowledge share memory.
    """

    mode: Array
    """int, [receiver, sender]; UNHEARD if nothing was received."""
    headroom_k: Array
    """[receiver, sender], NaN if nothing was received."""
    busy_s: Array
    """[receiver, sender], NaN if nothing was received."""
    difficulty: Array
    """[receiver, sender, slot] for the present slots (matched by job name), NaN where not broadcast."""
    p_saturation: Array
    """[receiver, sender, slot], NaN where not broadcast."""
    age_s: Array
    """[receiver, sender]: simulation seconds since that broadcast; inf if nothing was received."""


class Exchange(Protocol):
    """Carries the broadcasts of one step from every arm to every arm."""

    arms: tuple[str, ...]
    delivered: int
    """Broadcasts delivered to a peer, over all steps; one per receiver and sender."""
    late: int
    """Broadcasts that were lost on the channel, over all steps."""

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """Begin an episode without any received broadcasts; `rng` is for channels with loss or jitter."""
        ...

    def share(self, broadcast: Broadcast) -> PeerView:
        """Broadcast one step, and return what every arm knows after it.

        Raises:
            ValueError: the broadcast does not fit the arms, holds infinite numbers, or is older than the last one
                (`begin` first).
            BusError: the bus could not be opened, or is closed.
        """
        ...

    def close(self) -> None:
        """Release all resources; may be called twice."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object, /) -> None: ...


def checked_arms(arms: Sequence[str]) -> tuple[str, ...]:
    """The names of the arms as a tuple.

    Raises:
        ValueError: no arm, a name twice, or an empty name.
    """
    names = tuple(arms)
    if not names or not all(names) or len(set(names)) != len(names):
        raise ValueError(f"An exchange needs arms with different, non-empty names (got {names}).")
    return names


def check(broadcast: Broadcast, arms: tuple[str, ...]) -> None:
    """Refuse a broadcast that does not fit the arms or cannot be encoded.

    Raises:
        ValueError: names the field, what it is and what it should be.
    """
    slots = len(broadcast.jobs)
    shapes = {
        "mode": (len(arms),),
        "headroom_k": (len(arms),),
        "busy_s": (len(arms),),
        "difficulty": (len(arms), slots),
        "p_saturation": (len(arms), slots),
    }
    for name, shape in shapes.items():
        if np.shape(getattr(broadcast, name)) != shape:
            raise ValueError(
                f"Broadcast.{name} must have the shape {shape} (got {np.shape(getattr(broadcast, name))})."
            )
    if broadcast.temp_c.ndim != 2 or len(broadcast.temp_c) != len(arms) or not broadcast.temp_c.shape[1]:
        raise ValueError(
            f"Broadcast.temp_c must be [arm, joint] with {len(arms)} arms (got shape {broadcast.temp_c.shape})."
        )
    if len(broadcast.twin) != len(arms):
        raise ValueError(f"Broadcast.twin needs one version per arm ({len(arms)}, got {len(broadcast.twin)}).")
    named = [job for job in broadcast.jobs if job]
    if len(set(named)) != len(named):
        raise ValueError(f"Broadcast.jobs names a job twice (got {broadcast.jobs}).")
    if not math.isfinite(broadcast.time_s):
        raise ValueError(f"Broadcast.time_s must be finite (got {broadcast.time_s}).")
    for name in ("temp_c", "headroom_k", "busy_s"):
        if not np.isfinite(getattr(broadcast, name)).all():
            raise ValueError(f"Broadcast.{name} must be finite (got {getattr(broadcast, name)}).")
    for name in ("difficulty", "p_saturation"):
        if np.isinf(getattr(broadcast, name)).any():
            raise ValueError(
                f"Broadcast.{name} must be finite, or NaN where not known (got {getattr(broadcast, name)})."
            )
    if not np.isin(broadcast.mode, range(len(MODES))).all():
        raise ValueError(f"Broadcast.mode must be one of 0..{len(MODES) - 1} (got {broadcast.mode}).")


def check_order(time_s: float, last_s: float) -> None:
    """Refuse a broadcast that is older than the last one."""
    if time_s < last_s:
        raise ValueError(f"Broadcast of {time_s:g} s after that of {last_s:g} s; begin() starts a new episode.")
