"""What a live policy observes is what it observes in simulation: same plant, same jobs, same claims, step by step."""

import time
from collections import Counter
from dataclasses import replace
from itertools import product
from random import Random
from types import SimpleNamespace

import numpy as np
import pytest

from fleet.arm.space import SpaceTable, Sphere, plan_key
from fleet.bus.protocol.auction import Award, QuoteRequest, Submission
from fleet.bus.protocol.consensus import Bid
from fleet.bus.protocol.messages import State
from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.env.allocation_v2 import Episode, parallel_env
from fleet.errors import InfeasibleJob
from fleet.heat.motor import gen3_motors
from fleet.live.arm.awards import ArmHistory, AwardExecutor, ExecutorConfig
from fleet.live.arm.body import SimulatedBody
from fleet.live.arm.estimator import Estimator, NominalPeaks
from fleet.live.arm.node import ArmConfig, ArmNode, PlanningThread
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.book import JobBook
from fleet.live.consensus.grants import Granter
from fleet.live.consensus.participant import QUIET_S, Membership, Participant
from fleet.live.leases import Timing
from fleet.live.records import SendAward
from fleet.live.space import CellSpace
from fleet.motion import Phase
from fleet.observation import FIELDS, Observation
from fleet.robot import JOINTS, ThermalLimits
from scenarios.live.auctioneer import CentralAllocation, job_spec
from tests.live.wire import Wire

MAY_DIFFER = {
    "last_award": "a live fleet counts rounds, and there is a round only when a job can begin",
    "fleet_age_s": "live messages travel for some time",
}
"""Fields that may differ, and why. Two more differ in special cases: `peak_c` and `p_saturation` of a returned job, as
live arms predict the cycles that are left, and simulated arms the whole job; and an arm above the warning limit counts
as working (`working`, `fleet_working`), as a live one takes no job."""
HOUR_S = 3600.0
NAMES = ("arm_0", "arm_1", "arm_2")
CONSTANT = {"fleet_age_s", "break_in_s"}
"""Fields that have one value in these shifts."""
TOO_HEAVY = 6.0
"""Rating of the last arm, kg."""


def ambient_c(time_s: float) -> float:
    """Ambient temperature by fleet time, which changes every 100 s."""
    return 25.0 + time_s // 100.0


@pytest.fixture(autouse=True)
def planning_at_once(monkeypatch):
    """Have arms plan before they reply, however slow the machine is: what is not planned in time has no scores."""

    def plan(self, jobs, step, *, dry_run=False):
        for job in jobs:
            self._estimator.prepare(*job)

    monkeypatch.setattr(PlanningThread, "plan", plan)
    monkeypatch.setattr("fleet.live.arm.node.IDLE_PERIOD_S", 0.0)  # the fleet's time does not pass here


class Scores:
    """Scores that depend on the temperatures now, on the moment in the plan, and on the plan."""

    version = "scores"

    def score(self, plan, repetitions: int) -> Difficulty:
        share = np.linspace(0.0, 1.0, 5)
        time_s = share * plan.duration_s(repetitions)
        peak = Forecast(2.0 + 9.0 * share * plan.speed, np.full((5, KNOWN), 1.0 / KNOWN), time_s=time_s)
        risk = Forecast(share - 4.0 - plan.work.payload_kg / 9.0, np.full((5, KNOWN), 0.004), time_s=time_s)
        return Difficulty(np.full(JOINTS, 0.1 + 0.05 * plan.work.payload_kg * plan.speed), risk=risk, peak=peak)


class KeepingWire(Wire):
    """Keeps the last message of each kind that an arm publishes."""

    def __init__(self) -> None:
        super().__init__()
        self.last = {}

    def publisher(self, key, kind):
        return lambda message: self.last.update({kind: message})


class LiveShift:
    """The arms of a simulated shift as live arms, and an auctioneer; fleet time is a number."""

    def __init__(self, env, arms, jobs, conflicts, allocate, fleet) -> None:
        self.time_s = self.real_s = 0.0
        world, (plans, table) = env.world, conflicts
        volumes = SpaceTable({plan_key(plan): row for row, plan in enumerate(plans)}, table).by_path(plans)
        workspaces = dict.fromkeys(NAMES, Sphere(0.0, 0.0, 0.0, 1.5))
        self.jobs, self.fleet = tuple(map(job_spec, jobs)), fleet
        self.excludes = CellSpace(volumes=volumes, conflicts=table, workspaces=workspaces, clearance_m=0.02)
        timing = Timing(lease_s=HOUR_S, pause_s=(0.1, 0.2))
        rules = {"allocate": allocate, "timing": timing, "excludes": self.excludes}
        ledger = JobBook(arms=NAMES)
        self.auctioneer = Auctioneer("x", ledger, keep=lambda *_: None, boot="1", real_s=0.0, **rules)
        self.auctioneer.submit(Submission(self.jobs), 0.0)
        self.wires = {name: KeepingWire() for name in NAMES}
        self.nodes = {name: self.node(arm, world) for name, arm in zip(NAMES, arms, strict=True)}

    def node(self, arm, world) -> ArmNode:
        name = arm.robot.name
        limits, places = self.fleet.limits, {w.places[0].name: w.places[0] for w in arm.plans}

        def plan(work):
            if work not in arm.plans:
                raise InfeasibleJob(name, work.places[0].name, "too much", too_heavy=work in arm.too_heavy)
            return arm.plans[work]

        body = SimulatedBody(
            arm, limits, ambient_c, dt_s=world.dt_s, rng=np.random.default_rng(0), time_s=0.0, warm=False
        )
        config = ExecutorConfig(valid_s=HOUR_S)
        executor = AwardExecutor(name, lambda *_: None, ArmHistory(), nonce="n", config=config)
        clock = SimpleNamespace(speed=1e3 * world.dt_s, real_s=0.0, epoch="e", now_s=lambda _: self.time_s)
        return ArmNode(
            self.wires[name],
            body,
            executor,
            Estimator(arm.model, plan, places, NominalPeaks()),
            clock,
            ArmConfig(warning_c=limits.warning_c, rate_hz=1000.0, ambient_c=ambient_c),
            lambda node: Leases(self, node),
        )

    def publish(self) -> None:
        """Have every arm do what is due, and publish its state."""
        for name, node in self.nodes.items():
            before = self.wires[name].last.get(State)
            while self.wires[name].last.get(State) is before:
                node.serve(time.monotonic())
            self.auctioneer.apply_state(name, self.wires[name].last[State])

    def decide(self) -> None:
        """Have the auctioneer run a round, if a job can begin."""
        self.publish()
        self.real_s += 1.0  # every pause between rounds is over
        self.auctioneer.set_present(frozenset(NAMES))
        for _ in range(2):
            self.auctioneer.tick(self.real_s, self.time_s)
            while self.auctioneer.out:
                match self.auctioneer.out.popleft():
                    case QuoteRequest() as request:
                        for wire in self.wires.values():
                            self.auctioneer.add_quote(wire.handlers[QuoteRequest](request))
                    case SendAward(arm, award):
                        ack = self.wires[arm].handlers[Award](award)
                        assert ack.accepted, ack
                        self.auctioneer.apply_ack(ack, self.real_s, self.time_s)
        self.publish()

    def advance(self, dt_s: float) -> None:
        self.time_s += dt_s
        self.publish()


def observed_without_auctioneer(shift: LiveShift) -> dict[str, Observation]:
    """Return what the policy of each free arm would observe now if the arms allocated the jobs themselves."""
    observed = dict[str, Observation]()

    def wait(observation: Observation, place: int) -> int:
        observed[NAMES[place]] = observation
        return 0

    participants = {}
    for name, node in shift.nodes.items():
        book = copy_of(shift.auctioneer.book, shift.auctioneer.rounds.states)
        granter = Granter(name, NAMES, book, lambda *_: None, real_s=0.0, excludes=shift.excludes)
        membership = Membership(fleet=shift.fleet, choose=wait, slots=24, excludes=shift.excludes)
        participants[name] = Participant(node, granter, membership, boot=1, rng=Random(0))
        granter.add_jobs(shift.jobs)
        participants[name].states.update(shift.auctioneer.rounds.states)
        participants[name].set_present(frozenset(NAMES))
    for real_s in (0.0, 0.1):
        for participant in participants.values():
            participant.tick(real_s, shift.time_s)
            bids = [message for message in participant.out if isinstance(message, Bid)]
            for bid, peer in product(bids, participants.values()):
                peer.apply_bid(bid, real_s - QUIET_S)
            participant.out.clear()
    return observed


def copy_of(book: JobBook, states: dict[str, State]) -> JobBook:
    """Return the book of an arm that knows what an auctioneer knows."""
    copy = JobBook(is_central=False).replay(book.compact())
    for name in NAMES:
        awards = {grant.record.space for grant in book.open.values() if grant.record.arm == name}
        copy.space[name] = frozenset(awards | {states[name].space} - {""})
    return copy


class Leases:
    """Work source of an arm: the auctioneer itself, without a bus."""

    objection, wake_s = "", np.inf

    def __init__(self, shift: LiveShift, node: ArmNode) -> None:
        self.shift, self.executor = shift, node.executor

    def request_leases(self, auctioneer: str, request, asked_s: float) -> None:
        lease = self.shift.auctioneer.renew_leases(request, self.shift.real_s, self.shift.time_s)
        self.executor.apply_lease(lease, asked_s)

    def send_report(self, auctioneer: str, report) -> None:
        receipt = self.shift.auctioneer.apply_report(report, self.shift.real_s, self.shift.time_s)
        self.executor.apply_receipt(receipt)

    def step(self, real_s: float) -> None:
        pass

    prepare_quote = step


def arms_of(small, works):
    """Arms without sensor noise, each with a fast plan and one of less torque per work; the last one is weak."""
    quiet = replace(gen3_motors(), sensor_noise_k=np.zeros(JOINTS))
    arms = []
    for index in range(len(NAMES)):
        arm = small.arm(index, works, motors=quiet, model=Scores(), times=small.Times(cycle=10.0 + 2.0 * index))
        plans = {
            work: (along(fast, 0.01 * number), along(slower(small, fast), -0.01 * number))
            for number, (work, (fast,)) in enumerate(arm.plans.items(), start=1)
        }
        heavy = frozenset(work for work in works if index == len(NAMES) - 1 and work.payload_kg > TOO_HEAVY)
        allowed = {work: each for work, each in plans.items() if work not in heavy}
        arms.append(replace(arm, plans=allowed, too_heavy=heavy))
    return arms


def slower(small, plan):
    tau = 0.7 * small.torque(plan.work.payload_kg)
    return replace(plan, speed=0.6, cycle=small.phase(1.5 * plan.cycle.duration_s, tau))


def along(plan, q):
    """Return the plan along a path of its own: random pairs of plans exclude each other."""
    approach = plan.approach.profile.copy()
    approach[:, 0] = q
    return replace(plan, approach=Phase(approach, plan.approach.payload_kg))


@pytest.mark.ci_slow
@pytest.mark.parametrize(("error_c", "crowding"), [pytest.param(75.0, 0.4, marks=pytest.mark.slow), (40.0, 0.2)])
def test_a_live_policy_observes_what_it_observes_in_simulation(small, error_c, crowding):
    works = [small.work(place, kg) for place in ("bench", "press", "rack") for kg in (small.LIGHT, small.HOT)]
    limits = ThermalLimits(warning_c=error_c - 2.0, error_c=error_c, restart_c=error_c - 4.0, clear_s=60.0)
    arms = arms_of(small, works)
    all_plans = [plan for arm in arms for plans in arm.plans.values() for plan in plans]
    draw, space = np.random.default_rng(5), small.crowded(crowding)

    def content(i: int):
        start_s = float(draw.uniform(0, 500))
        return small.job(
            f"job_{i:02}",
            works[i % len(works)],
            repetitions=int(draw.integers(1, 9)),
            release_s=start_s,
            due_s=start_s + 400.0,
            value=float(draw.integers(1, 5)),
            after=(f"job_{i - 5:02}",) if i % 7 == 6 else (),
            expires=i % 4 == 0,
        )

    jobs = sorted((content(i) for i in range(24)), key=lambda job: job.release_s)

    def episode(seed):
        shop = {
            "arms": arms,
            "limits": limits,
            "slots": 24,
            "ticks": 120,
            "ambient_c": ambient_c(0.0),
            "plans_per_job": 2,
        }
        world, plant = small.shop([jobs], space=space, **shop)
        world.tables.ambient_c[0] = [[ambient_c(tick * world.dt_s)] * 3 for tick in range(world.ticks)]
        return Episode(world=world, plant=plant, twins=("scores",) * len(arms), sensors=seed)

    env = parallel_env(episode, ahead_s=np.inf, bids=True)
    env.reset(seed=0)
    policy = Comparing(env)
    live = LiveFleet(arms=NAMES, limits=limits, horizon_s=env.world.horizon_s)
    shift = LiveShift(env, arms, jobs, (all_plans, space(all_plans)[1]), CentralAllocation(policy, live), live)
    by_arms = 0
    while env.agents:
        policy.prepare(draw)
        shift.publish()
        every_third = shift.time_s % 30.0 == 0.0  # to save time
        for arm, observation in observed_without_auctioneer(shift).items() if every_third else ():
            policy.compare(arm, observation)
            by_arms += 1
        shift.decide()
        assert policy.compared or not any(policy.actions.values()), "a claim without a round"
        env.step(policy.actions)
        shift.advance(env.world.dt_s)
    assert policy.rounds > 25
    assert by_arms > 25
    assert policy.constant == CONSTANT


def without_hot_arms(o: Observation) -> Observation:
    """Return what an arm observes in simulation, with arms above the warning limit at work."""
    hot = (o.idle > 0) & (o.headroom_k <= 0)
    fleet = (o.fleet_working > 0) | ((o.fleet_faulted == 0) & (o.fleet_headroom_k <= 0))
    return replace(o, working=np.where(hot, 1.0, o.working), fleet_working=fleet * 1.0)


class Comparing:
    """A policy that draws legal claims in simulation, and makes the same claims live if it observes the same."""

    def __init__(self, env) -> None:
        self.env, self.rounds, self.seen = env, 0, Counter()
        self.values = {field.name: set() for field in FIELDS}

    @property
    def constant(self) -> set[str]:
        """Fields that had one value only."""
        return {name for name, values in self.values.items() if len(values) < 2}

    def prepare(self, draw) -> None:
        """Draw the claims of this step; an arm above the warning limit claims nothing, as live."""
        self.expected, self.compared = {arm: without_hot_arms(o) for arm, o in self.env.knowledge().items()}, False
        self.actions = {}
        for arm, o in self.expected.items():
            legal = np.flatnonzero(o.action_mask[:-1]) if o.headroom_k > 0 else [0]
            self.actions[arm] = int(draw.choice(legal)) if draw.random() < 0.6 else 0

    def act(self, observations):
        """Compare what the auctioneer observes, and make the claims."""
        for arm, live in observations.items():
            self.compare(arm, live)
        self.rounds, self.compared = self.rounds + 1, True
        return self.actions

    def compare(self, arm: str, live: Observation) -> None:
        """Compare what is observed live with what is observed in simulation."""
        o = self.expected[arm]
        slots = int(o.offered.sum())
        shown = {"slot": slots, "option": slots * 2}
        returned = np.repeat(o.returns[:slots] > 0, 2)
        for field in FIELDS:
            expected, got = getattr(o, field.name), getattr(live, field.name)
            if field.axes and field.axes[-1] in shown:
                expected = expected[..., : shown[field.axes[-1]]]
            self.values[field.name].update(np.unique(np.round(got, 3)).tolist())
            if field.name in MAY_DIFFER:
                continue
            if field.name in ("peak_c", "p_saturation"):
                expected, got = expected[~returned], got[~returned]
            where = f"{field.name} of {arm} at {self.env.truth.tick[0] * self.env.world.dt_s:g} s"
            np.testing.assert_allclose(got, expected, atol=2e-3, rtol=1e-5, err_msg=where)
        expected = np.append(o.action_mask[: slots * 2 + 1], 0) * (o.headroom_k > 0)
        np.testing.assert_array_equal(live.action_mask[1:], expected[1:])
