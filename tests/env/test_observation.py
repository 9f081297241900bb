"""Observations and action masks: every field against a reference from `World` and `State`, or worked by hand."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.special import expit

from fleet.bus.exchange.channel import Channel, Partition
from fleet.bus.exchange.memory import UNHEARD, Exchange, PeerView
from fleet.difficulty import Forecast
from fleet.engine.batch import Engine, Parts, RewardWeights, empty_parts
from fleet.engine.profile_plant import sensor_noise
from fleet.engine.shift import Episode, broadcast, initial, write_members
from fleet.engine.state import State
from fleet.engine.world import World
from fleet.env.allocation_v2 import parallel_env
from fleet.errors import ScenarioError
from fleet.heat.motor import gen3_motors
from fleet.observation import BIDS, FIELDS, LONG_S, Layout, Observation
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from scenarios.cell_layout import cell_of, near_of
from scenarios.prepare.batch import make_batch
from scenarios.prepare.fleet import make_env
from scenarios.spec.load import load
from tests.env.drafts import drafts, world_of
from tests.profiles import examples
from tests.shifts import Single, with_conflicts, with_tables


def test_fields_and_attributes_are_the_same_in_the_same_order() -> None:
    assert [f.name for f in FIELDS] == [f.name for f in fields(Observation) if f.name not in ("peers", "action_mask")]


def random_fields(layout: Layout, lead: tuple[int, ...], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return values of all fields within their bounds, of all arms of some envs, [..., arm, ...]."""
    return {
        f.name: rng.uniform(f.low, f.high, (*lead, layout.arms, *layout.shape(f))).astype(np.float32) for f in FIELDS
    }


@examples(60)
@given(
    arms=st.integers(1, 6), slots=st.integers(1, 9), plans=st.integers(1, 3), scaled=st.booleans(),
    delivered=st.booleans(), lead=st.sampled_from([(), (2,), (3, 2)]), seed=st.integers(0, 99),
)  # fmt: skip
def test_a_packed_observation_is_read_back(arms, slots, plans, scaled, delivered, lead, seed) -> None:
    """Exactly, also if scaled: scales are powers of two."""
    rng = np.random.default_rng(seed)
    layout = Layout(arms, slots, plans=plans, scaled=scaled, delivered=delivered)
    named = random_fields(layout, lead, rng)
    mask = rng.integers(0, 2, (*lead, arms, layout.actions)).astype(np.int8)
    vector = layout.pack(Observation(**named, peers=layout.peers, action_mask=mask))
    assert vector.shape == (*lead, arms, layout.size)
    assert vector.dtype == np.float32
    again = layout.read(vector, mask)
    for name, value in named.items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert again.action_mask is mask
    assert (np.frexp(layout.scales)[0] == 0.5).all()
    low, high = layout.bounds
    assert ((low <= vector) & (vector <= high)).all()
    assert layout.size == sum(int(np.prod(layout.shape(f))) for f in FIELDS)


def test_the_peers_of_an_unknown_arm_are_unknown() -> None:
    layout = Layout(3, 4)
    alone, all_ = (
        layout.read(np.zeros((*lead, layout.size), np.float32), np.ones((*lead, layout.actions), np.int8))
        for lead in ((), (2, 3))
    )
    assert (alone.peer_age_s.shape, alone.peer_difficulty.shape, alone.fleet_age_s.shape) == ((0,), (0, 4), (3,))
    assert (all_.peer_age_s.shape, all_.peer_difficulty.shape) == ((2, 3, 2), (2, 3, 2, 4))


def test_values_out_of_range_are_clipped() -> None:
    layout = Layout(2, 3)
    named = {f.name: np.full((2, *layout.shape(f)), 1e9) for f in FIELDS}
    mask = np.ones((2, layout.actions), np.int8)
    again = layout.read(layout.pack(Observation(**named, peers=layout.peers, action_mask=mask)), mask)
    for f in FIELDS:
        assert (getattr(again, f.name) == np.float32(f.high)).all()


def test_vectors_of_wrong_size_are_refused() -> None:
    layout = Layout(2, 3)
    with pytest.raises(
        ValueError, match=rf"An observation of 3 slots and 2 member\(s\) has {layout.size} elements, got 5"
    ):
        layout.read(np.zeros(5, np.float32), np.ones(4, np.int8))


# The reference


def with_second_plans(world: World, rng: np.random.Generator) -> World:
    """Return the world in which arms have a second, slower plan for some jobs, with its own space and scores."""
    work, plans, count = world.tables.work, np.concatenate([world.tables.plans] * 2), len(world.tables.plans)
    plans["times_s"][count:] *= 1.5
    new = np.triu(rng.random((2 * count,) * 2) < 0.2)
    conflicts = np.tile(world.conflicts, (2, 2)) ^ (new | new.T)
    for own in np.moveaxis(work["plan"], 2, 0):  # an arm's plans never exclude each other
        rows = np.concatenate([own[own >= 0], own[own >= 0] + count])
        conflicts[np.ix_(rows, rows)] = False
    more = work.copy()
    second = (work["plan"] >= 0) & (rng.random(work.shape) < 0.7)
    scored = second & (rng.random(work.shape) < 0.7)
    more["plan"] = np.where(second, work["plan"] + count, -1)
    more["travel_s"], more["cycle_s"] = (np.where(second, 1.5 * work[name], 0.0) for name in ("travel_s", "cycle_s"))
    more["difficulty"] = np.where(scored, rng.uniform(0.0, 2.0, work.shape), np.nan)
    more["p_saturation"] = np.where(scored, rng.random(work.shape), np.nan)
    more["risk"] = more["peak"] = -1
    other = with_tables(world, plans=plans, work=np.concatenate([work, more], axis=-1))
    return with_conflicts(replace(other, plans=world.plans * 2), conflicts)


def value_of(forecast: Forecast, known_c: np.ndarray, left_s: float = np.inf) -> float:
    """Value of a forecast by its definition."""
    counts = np.isfinite(forecast.offset)
    if forecast.time_s is not None:
        counts &= forecast.time_s <= left_s
    return max((forecast.offset + forecast.weight @ known_c)[counts], default=-np.inf)


def prediction(world: World, at: tuple[int, ...], known_c: np.ndarray, left_s: float = np.inf) -> tuple[float, float]:
    """P and the predicted peak of an option (arm, job, plan), 0.5 and 0 if unknown."""
    work = option_of(world, at)
    p, peak_c = float(work["p_saturation"]), 0.0
    if work["risk"] >= 0 or work["peak"] >= 0:
        a, j, n = at
        job = world.kinds[j]
        _, score = world.fleet[a].offers(*job.works)[job.repetitions][n]
        assert score is not None
        if score.risk is not None:
            curve, value = score.risk.curve, value_of(score.risk, known_c, left_s)
            p = expit(value) if curve is None else np.interp(value, *curve.T)
        if score.peak is not None:
            peak_c = value_of(score.peak, known_c, left_s)
    return 0.5 if np.isnan(p) else float(p), max(peak_c, -60.0)


def option_of(world: World, at: tuple[int, ...]) -> np.ndarray:
    """What an arm knows of its plans for a job of env 0, or of one plan, at (arm, job, ...)."""
    arm, job, *plan = at
    return world.tables.work[(0, job, arm, *plan)]


def stations_of(world: World, j: int) -> set[str]:
    return set(world.kinds[j].stations) if j >= 0 else set()


def groups_of(world: World, slots: list[int]) -> list[int]:
    """Return the group of each slot: a job takes that of the first one before it with which it shares a station."""
    groups: list[int] = []
    for k, j in enumerate(slots):
        taken = [stations_of(world, i) for i in slots[: k + 1]]
        shared = [groups[i] for i in range(k) if taken[i] & taken[k]]
        groups.append(0 if j < 0 else shared[0] if shared else k + 1)
    return groups


def blockers(world: World, state: State, a: int, plan: int) -> list[int]:
    """Return the arms away from home whose volumes exclude that of a plan of arm `a`."""
    away = state.plan[0].tolist()
    others = [b for b in range(len(away)) if b != a and away[b] >= 0]
    return [b for b in others if world.conflicts[plan, away[b]]]


def least_difficulty(world: World, a: int, j: int) -> float:
    """Return the least difficulty of an arm's plans for a job, -1 without any, 0 for an empty slot."""
    known = [] if j < 0 else [d for d in option_of(world, (a, j))["difficulty"].tolist() if not np.isnan(d)]
    return 0.0 if j < 0 else min(known, default=-1.0)


def is_absent(world: World, arm: int, now_s: float) -> bool:
    """Whether an arm has a break or is under repair now."""
    return any(a == arm and first * world.dt_s <= now_s < end * world.dt_s for a, first, end, _ in absences(world))


def break_in_s(world: World, arm: int, now_s: float) -> float:
    """Return the time until the next break of an arm, which does not foresee failures."""
    begins = [first for a, first, end, kind in absences(world) if a == arm and kind < 3 and end * world.dt_s > now_s]
    return min((max(0.0, first * world.dt_s - now_s) for first in begins), default=LONG_S)


def absences(world: World) -> list[tuple[int, int, int, int]]:
    return world.shifts[0].absences.tolist()


def reference(world: World, state: State, slots: list[int], key: int, layout: Layout) -> dict[str, np.ndarray]:
    """Compute the fields of all arms of env 0, [arm, ...], one by one; members as of this moment.

    Besides the fields: whether a plan has `free` space, and whether an arm may `give_back` its job.
    """
    arms, now_s, shift, kinds = len(world.arms), state.tick[0] * world.dt_s, world.shifts[0], world.kinds
    measured_c = state.temp_c[0, :, :7] + world.motors.sensor_noise_k * sensor_noise(key, state.tick[0], arms, 7)
    ambient_c = world.tables.ambient_c[0, min(int(state.tick[0]), world.ticks - 1)]
    times_s, away = world.tables.plans["times_s"], state.plan[0]
    occupied = set().union(*(stations_of(world, j) for j in state.job[0].tolist()))
    shared: dict[str, object] = {"left_s": world.horizon_s - now_s, "group": groups_of(world, slots)}
    each_slot = [
        [not occupied & stations_of(world, j), now_s - state.queued_s[0, j], shift.due_s[j] - now_s,
         kinds[j].work.payload_kg, kinds[j].value, state.returns[0, j], shift.expires[j]] if j >= 0 else [0] * 7
        for j in slots
    ]  # fmt: skip
    names = ("station_free", "age_s", "due_in_s", "payload_kg", "value", "returns", "expires")
    shared |= dict(zip(names, np.array(each_slot, dtype=float).T, strict=True))
    own: list[dict[str, object]] = []
    for a in range(arms):
        mode, todo = state.mode[0, a], int(state.todo[0, a])
        known_c = np.concatenate([measured_c[a], state.housing_c[0, a], ambient_c[a : a + 1]])
        busy_s = float(times_s[away[a]] @ [1, todo, 1] - state.progress_s[0, a]) if mode == WORKING else 0.0
        mine: dict[str, object] = {
            "working": mode == WORKING, "faulted": mode == FAULTED, "break_in_s": break_in_s(world, a, now_s),
            "last_award": state.last_award[0, a], "temp_c": measured_c[a],
            "busy_s": busy_s, "headroom_k": world.tables.warning_c - measured_c[a].max(),
            "error_headroom_k": world.tables.error_c - measured_c[a].max(),
            "housing_c": state.housing_c[0, a], "ambient_c": ambient_c[a],
            "job_value": 0.0, "job_cycles": 0.0, "job_peak_c": 0.0, "job_p": 0.0, "give_back": 0.0,
        }  # fmt: skip
        into_s = state.progress_s[0, a] - times_s[away[a], 0]
        if mode == WORKING and state.job[0, a] >= 0 and into_s < todo * times_s[away[a], 1] - 1e-6:
            j = int(state.job[0, a])
            n = option_of(world, (a, j))["plan"].tolist().index(away[a])
            p, peak_c = prediction(world, (a, j, n), known_c, busy_s)
            cycles = max(into_s, 0.0) / times_s[away[a], 1]
            mine |= {
                "job_value": kinds[j].value, "job_p": p,
                "job_peak_c": max(peak_c, measured_c[a].max()) if option_of(world, (a, j, n))["peak"] >= 0 else 0.0,
                "job_cycles": shift.repetitions[j] - state.cycles[0, j] - int(cycles + 1e-9),
                "give_back": np.ceil(cycles - 1e-9) < todo,
            }  # fmt: skip
        blocked, options = [], []
        for j in slots:
            plans = option_of(world, (a, j))["plan"].tolist() if j >= 0 else [-1] * world.plans_per_job
            blocked.append(plans[0] >= 0 and len(blockers(world, state, a, plans[0])) > 0)
            for n, plan in enumerate(plans):
                if plan < 0:
                    options.append([0.0] * 5)
                    continue
                duration_s = times_s[plan] @ [1, shift.repetitions[j] - state.cycles[0, j], 1]
                d, predicted = option_of(world, (a, j, n))["difficulty"], prediction(world, (a, j, n), known_c)
                options.append(
                    [duration_s, np.nan_to_num(d, nan=-1.0), *predicted, not blockers(world, state, a, plan)]
                )
        names = ("duration_s", "difficulty", "p_saturation", "peak_c", "free")
        mine |= dict(zip(names, np.array(options, dtype=float).T, strict=True)) | {"blocked": blocked}
        if busy_s > layout.ahead_s:
            mine |= {name: np.zeros(np.shape(mine[name])) for name in (*names, "blocked")}
        own.append(mine)
    least = np.array([[least_difficulty(world, b, j) for j in slots] for b in range(arms)])
    for a, mine in enumerate(own):
        members = list(range(arms)) if layout.near is None else list(layout.near[a])
        for name in ("working", "faulted", "busy_s", "headroom_k"):
            mine[f"fleet_{name}"] = [own[b][name] for b in members]
        for name, shown in (("working", 0), ("faulted", 1)):
            here = mine[f"fleet_{name}"]
            mine[f"fleet_{name}"] = [shown if is_absent(world, b, now_s) else here[m] for m, b in enumerate(members)]
        mine["fleet_age_s"] = [0.0] * len(members)
        mine["fleet_difficulty"] = least[members]
        for name in ("duration_s", "peak_c", "p_saturation"):
            mine[f"fleet_{name}"] = np.array([own[b][name] for b in members if layout.bids])
    return {name: np.array([(shared | each)[name] for each in own], dtype=float) for name in shared | own[0]}


def reference_mask(world: World, state: State, slots: list[int], expected: dict[str, np.ndarray]) -> np.ndarray:
    """Legal actions: wait, every plan of an idle arm with free stations and space, and give back."""
    now_s = state.tick[0] * world.dt_s
    idle = (state.mode[0] == IDLE) & ~np.array([is_absent(world, a, now_s) for a in range(len(world.arms))])
    legal = idle[:, None] * (expected["duration_s"] > 0) * expected["free"]
    legal *= np.repeat(expected["station_free"], world.plans_per_job, axis=1)
    return np.concatenate([np.ones((len(legal), 1)), legal, expected["give_back"][:, None]], axis=1)


COMPARED = {"temp_c": 1e-4, "housing_c": 1e-4, "ambient_c": 1e-4, "headroom_k": 1e-4, "error_headroom_k": 1e-4,
            "fleet_headroom_k": 1e-4, "peak_c": 1e-3, "fleet_peak_c": 1e-3, "job_peak_c": 1e-3}  # fmt: skip
"""Absolute tolerances of the fields in °C and K; of others it is 2e-5."""


def compare_with_reference(
    play, episode: Episode, seed: int, exchange: Exchange | None = None, **options
) -> tuple[State, int]:
    """Play a shift and compare every vector; return the last state, and the number of plans without free space.

    Args:
        exchange: Delivers at once.
        options: Of the layout.
    """
    world, rng = episode.world, np.random.default_rng(seed)
    runner, closed = Single(episode, exchange=exchange, **options), 0
    options = {"scaled": False, "ahead_s": np.inf, "delivered": exchange is not None, **options}
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job, **options)
    assert runner.layout == layout
    while True:
        slots = play.slots_of(world, runner.state)
        assert runner.engine.offers.slot_job[0].tolist() == slots
        actual = layout.read_parts(*runner.parts, runner.mask)
        expected = reference(world, runner.state, slots, episode.noise_key, layout)
        assert set(expected) - {"give_back", "free"} == {field.name for field in FIELDS}
        for name in (field.name for field in FIELDS):
            values, observed = expected[name], getattr(actual, name)
            atol = COMPARED.get(name, 2e-5)
            np.testing.assert_allclose(observed, values.reshape(observed.shape), rtol=1e-5, atol=atol, err_msg=name)
        assert not layout.scaled or np.abs(np.concatenate([each.ravel() for each in runner.parts])).max() < 30.0
        np.testing.assert_array_equal(runner.mask, reference_mask(world, runner.state, slots, expected))
        closed += int(((expected["duration_s"] > 0) > expected["free"]).sum())
        if runner.tick == world.ticks:
            return runner.state, closed
        runner.step(play.chosen(runner.mask, rng.random((len(world.arms), 2))))


@st.composite
def layouts(draw, arms: int):
    """Draw options of a layout."""
    near = draw(st.none() | st.integers(0, arms - 1))
    order = [draw(st.permutations([b for b in range(arms) if b != a])) for a in range(arms)]
    return {
        "scaled": draw(st.booleans()),
        "near": None if near is None else tuple(tuple(peers[:near]) for peers in order),
        "ahead_s": draw(st.sampled_from([np.inf, 0.0, 12.3, 40.3])),
        "bids": draw(st.booleans()),
    }


@pytest.mark.ci_slow
@examples(40)
@given(draft=drafts(), two_plans=st.booleans(), data=st.data())
def test_vectors_equal_the_reference(small, play, draft, two_plans, data) -> None:
    world, plant = world_of(small, draft)
    if two_plans:
        world = with_second_plans(world, np.random.default_rng(draft.seed))
    episode = Episode(world, plant, ("t",) * len(world.arms), np.random.SeedSequence(draft.seed))
    compare_with_reference(play, episode, draft.seed, **data.draw(layouts(len(world.arms))))


def test_shifts_of_the_comparison_include_faults_returned_jobs_and_closed_space(small, play) -> None:
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0)
    make = small.Shifts(arms=3, jobs=9, ticks=80, ambient_c=45.0, limits=limits, crowding=0.3, absences=7)
    near = ((2,), (0,), (1,))
    options: tuple[dict[str, Any], ...] = (
        {},
        {"ahead_s": 11.5},
        {"scaled": True, "bids": True},
        {"scaled": True, "near": near, "ahead_s": 40.3},
    )
    played = [
        compare_with_reference(play, make(np.random.SeedSequence(seed)), seed, **each)
        for seed, each in enumerate(options)
    ]
    last = [state for state, _ in played]
    assert sum(closed for _, closed in played) > 0
    assert sum(int(state.faults.sum()) for state in last) > 0
    assert sum(int(state.returns.sum()) for state in last) > 0
    assert sum(int(((state.faults > 0) & (state.mode != FAULTED)).sum()) for state in last) > 0


@pytest.mark.parametrize(("pieces", "curve"), [(1, False), (3, False), (2, True)])
def test_risks_equal_the_reference(small, play, pieces, curve) -> None:
    content = [small.work(place, payload) for place in ("a", "b") for payload in (small.LIGHT, small.HOT)]
    arms = [
        small.arm(0, content, model=play.Learned(pieces, curve=curve)),
        small.arm(1, content[:2], model=play.Learned(1, curve=False)),
        small.arm(2, content),
    ]
    jobs = [small.job(f"j{i}", content[i % 4], release_s=50.0 * (i % 3)) for i in range(6)]
    world, plant = small.shop([jobs], arms=arms, ticks=60)
    compare_with_reference(play, Episode(world, plant, ("t",) * 3, np.random.SeedSequence(1)), 3, bids=True)


@pytest.mark.parametrize("near", [None, ((2,), (0,), (1,))])
def test_messages_that_arrive_at_once_give_what_the_arms_know_of_each_other(small, play, near) -> None:
    """Over a channel with a partition that never comes."""
    make = small.Shifts(arms=3, jobs=5, ticks=40, crowding=0.3)
    never = Channel(partitions=(Partition(1e8, 2e8, (("arm_0",),)),))
    compare_with_reference(
        play, make(np.random.SeedSequence(4)), 4, Exchange(("arm_0", "arm_1", "arm_2"), never), near=near, bids=True
    )


NO_NOISE = replace(gen3_motors(), sensor_noise_k=np.zeros(7))


def received(arms: int, slots: int, **changes: np.ndarray) -> PeerView:
    """Return a view in which a message of every peer has just arrived: idle, no difficulties."""
    base = {
        "mode": np.zeros((arms, arms), int),
        "headroom_k": np.full((arms, arms), 30.0),
        "busy_s": np.zeros((arms, arms)),
        "difficulty": np.full((arms, arms, slots), np.nan),
        **{name: np.full((arms, arms, slots, 1), np.nan) for name in ("duration_s", "peak_c", "p_saturation")},
        "age_s": np.zeros((arms, arms)),
    }
    return PeerView(**(base | changes))


def peers_of(layout: Layout, view: PeerView) -> Observation:
    """Return the received fields of the vectors, leading axis [arm]; all slots hold jobs."""
    vectors = np.zeros((layout.arms, layout.size), np.float32)
    layout.write(vectors, {"group": np.ones(layout.slots)})
    write_members(layout, view, np.ones(layout.slots, bool), vectors[:, layout.shared :])
    return layout.read(vectors, np.ones((layout.arms, layout.slots + 1), np.int8))


def engine_at(world: World, state: State, **options) -> tuple[Engine, Parts]:
    """Return an engine in this state, and the parts of its observations.

    Args:
        options: Of the layout.
    """
    envs = len(world.shifts)
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job, **options)
    engine = Engine(world.tables, envs, layout, RewardWeights(), jobs=state.status.shape[1], compiled=False)
    rows, parts = np.arange(envs), empty_parts(layout, envs)
    engine.reset(rows, world.shifts)
    engine.load(state)
    engine.observe(rows, parts)
    return engine, parts


def observe(world: World, state: State, **options) -> Observation:
    """Return the observations in a state, leading axes [env, arm]."""
    engine, parts = engine_at(world, state, **options)
    return engine.layout.read_parts(*parts, engine.mask)


# Single fields


@pytest.mark.parametrize("near", [None, ((2, 1), (3, 0), (3, 1), (0, 2))], ids=["all", "nearest"])
def test_peers_are_those_of_the_layout_in_its_order(near) -> None:
    receiver, sender = np.indices((4, 4))
    view = received(
        4, 2,
        headroom_k=10.0 * receiver + sender,
        age_s=100.0 * receiver + sender,
        difficulty=np.stack([receiver + sender / 10, np.full((4, 4), np.nan)], axis=-1),
        mode=np.where(sender == 3, FAULTED, np.where(sender == 1, WORKING, IDLE)),
    )  # fmt: skip
    observed = peers_of(Layout(4, 2, near, delivered=True), view)
    for me in range(4):
        others = [a for a in range(4) if a != me] if near is None else list(near[me])
        assert observed.peers[me].tolist() == (others if near is None else [0, 1])
        assert observed.peer_headroom_k[me].tolist() == [10.0 * me + a for a in others]
        assert observed.peer_age_s[me].tolist() == [100.0 * me + a for a in others]
        assert observed.peer_difficulty[me, :, 0].tolist() == pytest.approx([me + a / 10 for a in others])
        assert observed.peer_known[me].tolist() == [[1, 0]] * len(others)
        assert (observed.peer_difficulty[me, :, 1] == -1).all()
        assert observed.peer_working[me].tolist() == [a == 1 for a in others]
        assert observed.peer_faulted[me].tolist() == [a == 3 for a in others]
        assert observed.peer_heard[me].all()


def test_a_peer_whose_messages_never_arrived_is_unknown() -> None:
    silent = np.array([[0, 1, 0]] * 3, bool)
    view = received(
        3, 2,
        mode=np.where(silent, UNHEARD, WORKING),
        headroom_k=np.where(silent, np.nan, 5.0),
        age_s=np.where(silent, np.inf, 7.0),
    )  # fmt: skip
    observed = peers_of(Layout(3, 2, delivered=True), view)
    assert observed.peer_heard[0].tolist() == [0, 1]
    assert observed.peer_age_s[0].tolist() == [LONG_S, 7.0]
    assert observed.peer_headroom_k[0].tolist() == [0.0, 5.0]
    assert observed.peer_working[0].tolist() == [0, 1]
    assert observed.peer_faulted[0].tolist() == [0, 0]
    assert all(np.isfinite(getattr(observed, field.name)).all() for field in FIELDS)


def test_bids_are_those_that_were_received() -> None:
    """A plan with both predictions, one without, no plan, and a slot without a job."""
    one = np.full((2, 2, 2, 2), np.nan)
    duration_s, peak_c, p_saturation = one.copy(), one.copy(), one.copy()
    duration_s[:, 1, 0], peak_c[:, 1, 0, 0], p_saturation[:, 1, 0, 0] = (60.0, 70.0), 55.0, 0.25
    layout = Layout(2, 2, plans=2, delivered=True, bids=True)
    view = received(2, 2, duration_s=duration_s, peak_c=peak_c, p_saturation=p_saturation)
    observed = peers_of(layout, view)
    assert observed.peer_duration_s[0].tolist() == [[60.0, 70.0, 0.0, 0.0]]
    assert observed.peer_peak_c[0].tolist() == [[55.0, 0.0, 0.0, 0.0]]
    assert observed.peer_p_saturation[0].tolist() == [[0.25, 0.5, 0.0, 0.0]]


def test_a_layout_without_bids_packs_observations_that_have_them() -> None:
    rich, plain = Layout(3, 2, plans=2, bids=True), Layout(3, 2, plans=2)
    low, high = rich.bounds
    vectors = np.random.default_rng(1).uniform(low, high, (4, rich.size)).astype(np.float32)
    seen = rich.read(vectors, np.ones((4, rich.actions), np.int8))
    np.testing.assert_array_equal(rich.pack(seen), vectors)
    packed = plain.read(plain.pack(seen), seen.action_mask)
    for name in (field.name for field in FIELDS if field.name not in BIDS):
        np.testing.assert_array_equal(getattr(packed, name), getattr(seen, name))


def test_slots_hold_each_arm_s_own_view_of_the_jobs(small) -> None:
    bench, rack = small.work("bench", 4.0), small.work("rack", 1.0)
    arms = [small.arm(0, [bench, rack]), small.arm(1, [bench], times=small.Times(1.0, 20.0, 4.0))]
    jobs = [
        small.job("a", bench, repetitions=5, due_s=100.0, value=3.0),
        small.job("b", rack, repetitions=2, release_s=15.0, due_s=50.0, value=2.0),
    ]
    world, _ = small.shop([jobs], arms=arms, slots=3)
    state = initial(world)
    state.tick[:] = 2
    observed = observe(world, state)
    assert observed.offered[0].tolist() == [[1, 1, 0]] * 2
    assert observed.feasible[0].tolist() == [[1, 1, 0], [1, 0, 0]]
    assert observed.known[0].tolist() == [[1, 1, 0], [1, 0, 0]]
    # 3 + 5 · 10 + 2, 3 + 2 · 10 + 2, and 1 + 5 · 20 + 4 s; now is 20 s.
    assert observed.duration_s[0].tolist() == [[55.0, 25.0, 0.0], [105.0, 0.0, 0.0]]
    assert observed.slack_s[0].tolist() == [[25.0, 5.0, 0.0], [-25.0, 0.0, 0.0]]
    assert observed.age_s[0].tolist() == [[20.0, 5.0, 0.0]] * 2
    assert observed.payload_kg[0].tolist() == [[4.0, 1.0, 0.0]] * 2
    assert observed.value[0].tolist() == [[3.0, 2.0, 0.0]] * 2
    expected = arms[1].model.score(arms[1].plans[bench][0], 5)
    assert expected is not None
    assert observed.difficulty[0, 1].tolist() == pytest.approx([expected.total, 0.0, 0.0])
    assert observed.p_saturation[0, 1].tolist() == pytest.approx([expected.p_saturation, 0.0, 0.0])
    assert observed.left_s[0].tolist() == [world.horizon_s - 20.0] * 2
    assert observed.due_in_s[0].tolist() == [[80.0, 30.0, 0.0]] * 2
    assert observed.group[0].tolist() == [[1, 2, 0]] * 2
    assert observed.action_mask[0].tolist() == [[1, 1, 1, 0, 0], [1, 1, 0, 0, 0]]


def test_an_arm_broadcasts_what_it_measures_and_its_scores(small) -> None:
    content = small.work()
    arms = [small.arm(i, [content], motors=NO_NOISE) for i in range(2)]
    world, _ = small.shop([[small.job("a"), small.job("b", release_s=99.0)]], arms=arms, slots=3)
    state = initial(world)
    measured = np.arange(14.0).reshape(1, 2, 7) + 40.0
    state.temp_c[..., :7] = measured
    engine, parts = engine_at(world, state, scaled=True, delivered=True)
    message = broadcast(engine, parts, world.shifts[0].names, ("x", "y"))
    assert message.time_s == 0.0
    assert message.twin == ("x", "y")
    assert message.jobs == ("a", "", "")
    assert message.headroom_k.tolist() == [60.0 - 46.0, 60.0 - 53.0]
    assert message.temp_c.tolist() == measured[0].tolist()
    assert message.difficulty[:, 0] == pytest.approx(world.tables.work["difficulty"][0, 0, :, 0])
    assert message.p_saturation[:, 0] == pytest.approx(world.tables.work["p_saturation"][0, 0])
    assert np.isnan(message.difficulty[:, 1:]).all()
    assert np.isnan(message.p_saturation[:, 1:]).all()


# Peers and sensors in an episode


def test_temperatures_are_measured_with_the_noise_of_the_sensors(small) -> None:
    env = parallel_env(small.Shifts(arms=2, jobs=0, ticks=400))
    env.reset(seed=1)
    errors = []
    while env.agents:
        truth = env.truth.temp_c[0, :, :7]
        errors.append([env.knowledge()[arm].temp_c - truth[a] for a, arm in enumerate(env.possible_agents)])
        env.step({})
    actual = np.array(errors).std(axis=0)
    # The relative error of a standard deviation from n readings is 1/√(2n); four times that, for 14 sensors.
    assert actual == pytest.approx(env.world.motors.sensor_noise_k, rel=4 / np.sqrt(800))


@pytest.mark.parametrize("name", ["quickstart", "heat_wave"])
@pytest.mark.parametrize("peers", [1, 2])
def test_the_peers_are_the_nearest_in_space(name, peers) -> None:
    scenario = load(name)
    mounts_m = np.array(cell_of(scenario).mounts_m)
    far_m, _ = KDTree(mounts_m).query(mounts_m, k=peers + 1)
    near = near_of(scenario, peers)
    assert near is not None
    for a, own in enumerate(near):
        assert a not in own
        assert len(set(own)) == peers
        np.testing.assert_allclose(np.linalg.norm(mounts_m[list(own)] - mounts_m[a], axis=1), far_m[a, 1:])


def test_a_number_of_peers_shares_the_nearest_ones(cell, plans) -> None:
    options = {"difficulty": "blind", "cache": plans, "peers": 1}
    for layout in (make_batch(cell, 2, **options).layout, make_env(cell, **options).layout):
        assert layout.near == near_of(cell, 1)


@pytest.mark.parametrize("peers", [-1, 4, 1.5, True, "all"])
def test_invalid_numbers_of_peers_are_refused(peers) -> None:
    for make in (lambda **more: make_batch("quickstart", 2, **more), lambda **more: make_env("quickstart", **more)):
        with pytest.raises(ScenarioError, match=r"peers must be None or an integer from 0 to 3 \(got "):
            make(difficulty="blind", peers=peers)
