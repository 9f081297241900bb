"""The exchange: what every arm says at a tick, and what every arm then knows of every other.

Two of them exist: `MemoryExchange` without a bus, and `ZenohExchange` over one. On the same channel and with the same
chance they give the same arrays. `begin` starts a new episode: what was heard before is forgotten.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from fleet.telemetry import MODES

Array = np.ndarray

UNHEARD = -1
"""The mode of an arm that was never heard."""


@dataclass(frozen=True, eq=False)
class Words:
    """What every arm says at one tick."""

    time_s: float
    mode: Array
    """int, [arm]: 0 idle, 1 working, 2 faulted."""
    temp_c: Array
    """Measured motor temperatures, [arm, joint]."""
    headroom_k: Array
    """Warning limit minus hottest motor, [arm]."""
    jobs: tuple[str, ...]
    """Names of the jobs on offer, [slot]; "" for an empty slot, of which nothing is said."""
    difficulty: Array
    """[arm, slot], NaN where the arm has no score or cannot do the job."""
    p_saturation: Array
    """[arm, slot], NaN where not known."""
    twin: tuple[str, ...]
    """Twin version per arm."""


@dataclass(frozen=True, eq=False)
class Heard:
    """What every arm knows of every arm after a tick: [receiver, sender, ...]; the own row is the own word."""

    mode: Array
    """int, [receiver, sender]; UNHEARD when never heard."""
    headroom_k: Array
    """[receiver, sender], NaN when never heard."""
    difficulty: Array
    """[receiver, sender, slot] for the slots of now (matched by job name), NaN when not said."""
    p_saturation: Array
    """[receiver, sender, slot], NaN when not said."""
    age_s: Array
    """[receiver, sender]: simulation seconds since that word was said; inf when never heard."""


class Exchange(Protocol):
    """Carries the words of one tick from every arm to every arm."""

    arms: tuple[str, ...]
    delivered: int
    """Words that reached a peer in time, over all ticks; one per receiver and sender."""
    malformed: int
    """Messages that were not what they should be; counted, logged, left out."""
    late: int
    """Words that did not reach a peer in the tick they were due, over all ticks."""

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """A new episode: forget what was heard; chance, where there is any, comes from `rng` from now on."""
        ...

    def share(self, words: Words) -> Heard:
        """Say the words of one tick, and return what every arm knows thereafter.

        Raises:
            ValueError: the words do not fit the arms, hold numbers that cannot be said, or are of a time before the
                last ones (`begin` first).
            BusError: the bus could not be opened, or is closed.
        """
        ...

    def close(self) -> None:
        """Let go of everything; twice is fine."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any, /) -> None: ...


@dataclass(frozen=True, eq=False)
class Condition:
    """How one arm said it was."""

    time_s: float
    mode: int
    headroom_k: float


@dataclass(frozen=True, eq=False)
class Scores:
    """How hard one arm said it finds the jobs of that time."""

    time_s: float
    jobs: tuple[str, ...]
    difficulty: Sequence[float] | Array
    """[job], NaN where not said."""
    p_saturation: Sequence[float] | Array
    """[job], NaN where not said."""


Word = TypeVar("Word", Condition, Scores)


def assemble(
    now_s: float,
    jobs: tuple[str, ...],
    conditions: Sequence[Sequence[Condition | None]],
    scores: Sequence[Sequence[Scores | None]],
) -> Heard:
    """The arrays of what is known, from the last word each receiver has of each sender, [receiver][sender].

    Age is that of the older of the two words. Equal words held by several receivers are laid out once.
    """
    arms, slots = len(conditions), len(jobs)
    state_row, states = _interned(conditions)
    mode = np.array([*(word.mode for word in states), UNHEARD])[state_row]
    headroom = np.array([*(word.headroom_k for word in states), math.nan])[state_row]
    state_time = np.array([*(word.time_s for word in states), -math.inf])[state_row]

    score_row, said = _interned(scores)
    table = np.full((2, len(said) + 1, slots), np.nan)
    for row, word in enumerate(said):
        if word.jobs == jobs:
            table[0, row] = word.difficulty
            table[1, row] = word.p_saturation
            continue
        columns = {name: column for column, name in enumerate(word.jobs)}
        for slot, name in enumerate(jobs):
            if name in columns:
                table[0, row, slot] = word.difficulty[columns[name]]
                table[1, row, slot] = word.p_saturation[columns[name]]
    empty = [slot for slot, name in enumerate(jobs) if not name]
    table[:, :, empty] = np.nan
    score_time = np.array([*(word.time_s for word in said), -math.inf])[score_row]
    known = table[:, score_row]
    assert known.shape == (2, arms, arms, slots)
    return Heard(mode, headroom, known[0], known[1], now_s - np.minimum(state_time, score_time))


def checked_arms(arms: Sequence[str]) -> tuple[str, ...]:
    """The names of the arms as a tuple.

    Raises:
        ValueError: no arm, a name twice, or an empty name.
    """
    names = tuple(arms)
    if not names or not all(names) or len(set(names)) != len(names):
        raise ValueError(f"An exchange needs arms with different, non-empty names (got {names}).")
    return names


def check(words: Words, arms: tuple[str, ...]) -> None:
    """Refuse words that do not fit the arms or that no bus could carry.

    Raises:
        ValueError: names the field, what it is and what it should be.
    """
    slots = len(words.jobs)
    shapes = {
        "mode": (len(arms),),
        "headroom_k": (len(arms),),
        "difficulty": (len(arms), slots),
        "p_saturation": (len(arms), slots),
    }
    for name, shape in shapes.items():
        if np.shape(getattr(words, name)) != shape:
            raise ValueError(f"Words.{name} must have the shape {shape} (got {np.shape(getattr(words, name))}).")
    if words.temp_c.ndim != 2 or len(words.temp_c) != len(arms) or not words.temp_c.shape[1]:
        raise ValueError(f"Words.temp_c must be [arm, joint] with {len(arms)} arms (got shape {words.temp_c.shape}).")
    if len(words.twin) != len(arms):
        raise ValueError(f"Words.twin needs one version per arm ({len(arms)}, got {len(words.twin)}).")
    named = [job for job in words.jobs if job]
    if len(set(named)) != len(named):
        raise ValueError(f"Words.jobs names a job twice (got {words.jobs}).")
    if not math.isfinite(words.time_s):
        raise ValueError(f"Words.time_s must be finite (got {words.time_s}).")
    for name in ("temp_c", "headroom_k"):
        if not np.isfinite(getattr(words, name)).all():
            raise ValueError(f"Words.{name} must be finite (got {getattr(words, name)}).")
    for name in ("difficulty", "p_saturation"):
        if np.isinf(getattr(words, name)).any():
            raise ValueError(f"Words.{name} must be finite, or NaN where not known (got {getattr(words, name)}).")
    if not np.isin(words.mode, range(len(MODES))).all():
        raise ValueError(f"Words.mode must be one of 0..{len(MODES) - 1} (got {words.mode}).")


def check_order(time_s: float, last_s: float) -> None:
    """Refuse words of a time before the last ones."""
    if time_s < last_s:
        raise ValueError(f"Words of {time_s:g} s come after those of {last_s:g} s: begin() starts a new episode.")


def _interned(known: Sequence[Sequence[Word | None]]) -> tuple[Array, list[Word]]:
    """[receiver, sender] index of each word into the list of different ones; -1, the place after the last, for none."""
    place: dict[int, int] = {id(None): -1}
    different: list[Word] = []
    rows: list[list[int]] = []
    last: object = None
    for row in known:
        if row is last:  # what all know alike is looked at once
            rows.append(rows[-1])
            continue
        last = row
        rows.append([])
        for word in row:
            index = place.get(id(word))
            if index is None and word is not None:
                index = place[id(word)] = len(different)
                different.append(word)
            rows[-1].append(-1 if index is None else index)
    return np.array(rows, dtype=int), different
