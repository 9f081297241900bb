"""Arrays of a world: jobs, plans and offers."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.difficulty import KNOWN, Blind, Difficulty, Forecast
from fleet.engine.shift import initial, open_jobs, step
from fleet.engine.state import DONE
from fleet.engine.world import warm_start
from fleet.heat.motor import gen3_motors
from fleet.motion import Plan


class Scripted:
    """Returns a given score for each elbow variant, or None."""

    version = "scripted"

    def __init__(self, by_elbow: dict[int, float | None]) -> None:
        self._by_elbow = by_elbow

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        total = self._by_elbow[plan.elbow]
        return None if total is None else Difficulty(np.full(7, total / 7.0), 0.25)


def with_variants(small, by_elbow):
    content = small.work()
    arm = small.arm(0, [content])
    plan = arm.plans[content][0]
    return replace(arm, model=Scripted(by_elbow), plans={content: tuple(replace(plan, elbow=k) for k in by_elbow)})


def test_an_arm_offers_its_fastest_plan_whatever_the_scores(small) -> None:
    arm = with_variants(small, {0: 3.0, 1: 1.0, 2: 2.0})
    content = small.work()
    slow, fast, middle = arm.plans[content]
    fast = replace(fast, approach=small.phase(2.5, fast.approach.profile[0, 2]))
    arm = replace(arm, plans={content: (slow, middle, fast)})
    (offer,) = arm.offers(content)[3]
    assert offer[0] is fast
    world, _ = small.shop([[small.job("a")]], arms=[arm])
    assert world.tables.work["difficulty"][0, 0, 0, 0] == pytest.approx(1.0)
    assert world.tables.work["p_saturation"][0, 0, 0, 0] == 0.25
    assert len(world.tables.plans) == len(world.plans) == 1


def test_without_a_score_it_offers_the_first_plan(small) -> None:
    for arm in (
        with_variants(small, {0: None, 1: None}),
        replace(with_variants(small, {0: 1.0, 1: 0.5}), model=Blind()),
    ):
        (offer,) = arm.offers(small.work())[3]
        assert (offer[0].elbow, offer[1]) == (0, None)
        world, _ = small.shop([[small.job("a")]], arms=[arm])
        assert np.isnan(world.tables.work["difficulty"]).all()
        assert (world.tables.work["plan"] == 0).all()


def test_each_number_of_repetitions_has_its_own_score(small) -> None:
    class ByLength:
        version = "by length"

        def score(self, plan: Plan, repetitions: int) -> Difficulty:
            return Difficulty(np.full(7, repetitions / 100.0))

    content = small.work()
    jobs = [small.job("a", content, repetitions=5), small.job("b", content, repetitions=9)]
    world, _ = small.shop([jobs], arms=[small.arm(0, [content], model=ByLength())])
    assert world.tables.work["difficulty"][0, :, 0, 0] == pytest.approx([0.35, 0.63])
    assert world.tables.work["plan"][0, :, 0, 0].tolist() == [0, 0]


def test_unplanned_work_is_not_offered(small) -> None:
    arm = small.arm(0, [small.work("rack")])
    assert arm.offers(small.work())[3] == []
    world, _ = small.shop([[small.job("a")]], arms=[arm])
    assert world.tables.work["plan"].tolist() == [[[[-1]]]]


def test_the_plan_table_holds_times_mean_heat_and_peaks(small) -> None:
    content = small.work(payload_kg=2.0)
    world, _ = small.shop([[small.job("a", content)]], arms=[small.arm(0, [content], qd=0.5)])
    tau = small.torque(2.0)
    assert world.tables.plans["times_s"].tolist() == [[3.0, 10.0, 2.0]]
    assert world.fleet[0].driven(world.plans[0])[3] == pytest.approx(tau)
    motors = gen3_motors()
    assert world.tables.plans["current_sq"][0, 0, :7] == pytest.approx((tau / motors.eta / motors.torque_per_amp) ** 2)
    assert (world.tables.plans["friction_w"][0, [0, 2]] == 0).all()
    friction = motors.coulomb_nm * np.tanh(0.5 / motors.v0_rad_s) + motors.viscous_nms_per_rad * 0.5
    assert world.tables.plans["friction_w"][0, 1, :7] == pytest.approx(friction * 0.5)


def test_the_shifts_equal_the_jobs(small) -> None:
    first = small.job("first", small.work("bench", 2.0, to="rack"), release_s=5.0, due_s=9.0, value=7.0, repetitions=4)
    second = small.job("second", small.work("rack"), after=("first",))
    world, _ = small.shop([[first, second], [second.__class__(**{**vars(second), "after": ()})]])
    shift, other = world.shifts
    assert world.stations == ("bench", "rack")
    assert world.tables.stations[0, :, 0].tolist() == [0b11, 0b10, 0b10, 0]
    assert (shift.kind.tolist(), other.kind.tolist()) == ([0, 1], [2])
    assert (shift.after.tolist(), other.after.tolist()) == ([[-1], [0]], [[-1]])
    assert (shift.names, other.names) == (("first", "second"), ("second",))
    assert [column[0] for column in (shift.release_s, shift.due_s, shift.repetitions)] == [5.0, 9.0, 4]
    assert [column[0, 0] for column in (world.tables.value, world.tables.payload_kg)] == [7.0, 2.0]


def test_cyclic_predecessors_and_an_arm_that_overheats_at_home_are_refused(small) -> None:
    with pytest.raises(ValueError, match="in a cycle"):
        small.shop([[small.job("a", after=("b",)), small.job("b", after=("a",))]])
    arm = replace(small.arm(0, [small.work()]), rest_tau=np.full(7, 500.0))
    with pytest.raises(ValueError, match="Arm 'arm_0' has no steady state when idle at home at 25 °C"):
        small.shop([[small.job("a")]], arms=[arm], start_warm=True)


def test_arms_begin_at_ambient_or_idle_warm(small) -> None:
    arms = [small.arm(0, [small.work()])]
    cold, _ = small.shop([[small.job("a")]], arms=arms, ambient_c=21.0)
    warm, _ = small.shop([[small.job("a")]], arms=arms, ambient_c=21.0, start_warm=True)
    assert (initial(cold).temp_c == 21.0).all()
    assert initial(warm).temp_c[0, 0] == pytest.approx(warm_start(arms[0], 21.0))
    assert (initial(warm).temp_c > 21.0).all()


def test_offers_index_rows_of_the_risk_table(small) -> None:
    class ByLength:
        version = "by length"

        def score(self, plan: Plan, repetitions: int) -> Difficulty:
            return Difficulty(
                np.zeros(7), risk=Forecast(np.full(repetitions, -1.0 * repetitions), np.zeros((repetitions, KNOWN)))
            )

    content = small.work()
    jobs = [small.job("a", content, repetitions=2), small.job("b", content, repetitions=3), small.job("c", content)]
    arms = [small.arm(0, [content], model=ByLength()), small.arm(1, [content])]
    tables = small.shop([jobs, jobs[:1]], arms=arms)[0].tables
    assert tables.work["risk"][0, ..., 0].tolist() == [[0, -1], [1, -1], [1, -1], [0, -1]]  # [kind, arm]
    assert tables.forecast_block[:, 0, :3].tolist() == [[-2.0, -2.0, -np.inf], [-3.0] * 3]
    assert np.isnan(tables.work["p_saturation"][:, :, 0]).all()
    assert len(small.shop([jobs], arms=[arms[1]])[0].tables.forecast_block) == 0


def alternatives(small, count: int, stations: int = 3):
    """Jobs that serve alike at any of some stations."""
    works = [small.work(f"station_{i}") for i in range(stations)]
    return [small.job(f"j{i}", works[0], alternatives=tuple(works[1:])) for i in range(count)], works


def test_the_second_plan_of_a_job_with_alternatives_is_at_another_station(small) -> None:
    (job,), works = alternatives(small, 1)
    arm = small.arm(0, works)
    fast = replace(arm.plans[works[1]][0], approach=small.phase(2.5, arm.plans[works[1]][0].approach.profile[0, 2]))
    arm = replace(arm, plans={**arm.plans, works[1]: (fast,)})
    (first, _), (second, _) = arm.offers(*job.works)[3]
    assert first is fast
    assert second.work in (works[0], works[2])
    world, _ = small.shop([[job]], arms=[arm], plans_per_job=2)
    assert world.stations == ()  # no station that every alternative needs


@pytest.mark.parametrize("seed", range(2))
def test_arms_with_alternatives_never_share_a_station(small, seed) -> None:
    """Random legal claims: at every moment the arms at work are at different stations, and all jobs are done."""
    jobs, works = alternatives(small, 6)
    rng, arms = np.random.default_rng(seed), [small.arm(i, works) for i in range(4)]
    world, plant = small.shop([jobs], arms=arms, slots=6, plans_per_job=2)
    state, most = initial(world), 0
    station = {
        world.tables.work["plan"][0, 0, a, n]: plan.work.stations
        for a, arm in enumerate(arms)
        for n, (plan, _) in enumerate(arm.offers(*jobs[0].works)[3])
    }
    for _ in range(world.ticks):
        mask = open_jobs(world, state)[1][0]
        actions = np.array([[rng.choice(np.flatnonzero(row[:-1])) for row in mask]])
        state = step(world, state, actions, plant).state
        busy = [station[row] for row in state.plan[0].tolist() if row >= 0]
        assert len(set(busy)) == len(busy)
        most = max(most, len(busy))
    assert most == 2  # an arm offers the fastest plan, at the first station, and one at another
    assert (state.status[0] == DONE).all()
