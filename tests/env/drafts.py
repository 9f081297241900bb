"""Random small cells with their jobs: any works, abilities, precedence, limits and shared space."""

from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

from fleet.engine.profile_plant import ProfilePlant
from fleet.engine.world import World
from fleet.fields import MAX_SEED
from fleet.job import Job
from fleet.robot import ThermalLimits

TICKS, DT_S = 45, 10.0
PLACES = ("bench", "press", "rack")


@dataclass(frozen=True)
class Draft:
    works: tuple[tuple[str, str | None, float], ...]
    """From, to (None for a hold), kg."""
    able: tuple[frozenset[int], ...]
    """Works that each arm can do."""
    jobs: tuple[tuple[int, int, float, frozenset[int]], ...]
    """Work, repetitions, release and predecessors."""
    slots: int
    error_c: float
    ambient_c: float
    start_warm: bool
    power_off: bool
    touching: float
    """Share of the pairs of plans of two arms that exclude each other."""
    move_home_s: float
    seed: int


@st.composite
def drafts(draw: Any) -> Draft:
    """Draw small scenarios; some arm can do every work."""
    payload = st.sampled_from([8.0, 4.0, 0.0])
    pair = st.tuples(st.sampled_from(PLACES), st.none() | st.sampled_from(PLACES), payload)
    works = draw(st.lists(pair.filter(lambda w: w[0] != w[1]), min_size=1, max_size=4, unique=True))
    arms = draw(st.integers(1, 4))
    numbers = st.just(frozenset(range(len(works)))) | st.frozensets(st.integers(0, len(works) - 1))
    able = [draw(numbers) for _ in range(arms)]
    able[0] |= set(range(len(works))) - frozenset().union(*able)
    jobs = []
    for j in range(draw(st.integers(0, 10))):
        before = draw(st.frozensets(st.integers(0, j - 1), max_size=2)) if j else frozenset[int]()
        release = draw(st.just(0.0) | st.floats(0.0, TICKS * DT_S, allow_nan=False, width=32))
        jobs.append((draw(st.integers(0, len(works) - 1)), draw(st.integers(1, 5)), release, before))
    return Draft(
        works=tuple(works),
        able=tuple(able),
        jobs=tuple(jobs),
        slots=draw(st.integers(1, 5)),
        error_c=draw(st.sampled_from([44.0, 50.0, 75.0])),
        ambient_c=draw(st.sampled_from([38.0, 25.0, -10.0])),
        start_warm=draw(st.booleans()),
        power_off=draw(st.booleans()),
        touching=draw(st.sampled_from([0.0, 0.3, 1.0])),
        move_home_s=draw(st.sampled_from([900.0, 60.0, 0.0])),
        seed=draw(st.integers(0, MAX_SEED)),
    )


def world_of(small: Any, draft: Draft) -> tuple[World, ProfilePlant]:
    works = [small.work(place, kg, to=to) for place, to, kg in draft.works]
    arms = [
        small.arm(i, [works[w] for w in sorted(able)], times=small.Times(3.0 + i, 7.0 + 2 * i, 2.0))
        for i, able in enumerate(draft.able)
    ]
    jobs: list[Job] = [
        small.job(
            f"j{j}",
            works[w],
            repetitions=n,
            release_s=s,
            due_s=s + 60.0,
            value=1.0 + j,
            after=tuple(f"j{k}" for k in sorted(before)),
        )
        for j, (w, n, s, before) in enumerate(draft.jobs)
    ]
    e = draft.error_c
    limits = ThermalLimits(
        warning_c=e - 4, error_c=e, restart_c=e - 6, clear_s=25.0, power_off_on_fault=draft.power_off,
        move_home_s=draft.move_home_s,
    )  # fmt: skip
    return small.shop(
        [jobs], arms=arms, limits=limits, ticks=TICKS, slots=draft.slots, ambient_c=draft.ambient_c, dt_s=DT_S,
        start_warm=draft.start_warm, space=small.crowded(draft.touching),
    )  # fmt: skip
