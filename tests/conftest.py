"""Small worlds in which every figure is known beforehand: constant torques, whole seconds, no MuJoCo and no twin."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from fleet.difficulty import Difficulty, DifficultyModel
from fleet.engine.batch import RewardWeights, Shift
from fleet.engine.profile_plant import ProfilePlant
from fleet.engine.state import ABSENCE
from fleet.engine.world import Arm, Space, World, build_world
from fleet.env.allocation_v2 import Episode
from fleet.env.lookahead import CellSimulator
from fleet.env.vector import BatchEnv, Library
from fleet.heat.motor import Motors, gen3_motors
from fleet.heat.thermal import ThermalModel, gen3_network, thermal_model
from fleet.job import Job, Place, Work
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.robot import JOINTS, Robot, ThermalLimits
from fleet.seeding import key_of
from tests import profiles  # noqa: F401 -- loads the profile of Hypothesis
from tests.commands import CommandResult, call, start_server

# A shell starts background jobs with Ctrl-C ignored, and their child processes inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests have a router and all its sessions in one process, where two receiving threads are too few on a busy machine.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 8))")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the engine before xdist starts workers: each would compile it, at the same time.

    They also share one process that forks commands.
    """
    if session.config.getoption("numprocesses", None):
        start_server()
        library = Shifts().library()
        env = BatchEnv(library, 1)
        env.reset()
        env.step(np.zeros((1, len(library.arms)), int))
        CellSimulator(library.tables, len(library.arms), library.slots, RewardWeights())


@pytest.fixture(autouse=True)
def signal_handlers_are_restored() -> Iterator[None]:
    """Fail the test that leaves another handler of Ctrl-C or SIGTERM to the tests after it."""
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


LIGHT, WARM, HOT = 0.0, 4.0, 8.0
"""Payloads, kg: cool for ever; past 60 °C within the hour; past 75 °C within minutes."""


def torque(payload_kg: float) -> np.ndarray:
    """Joint 2 bears the arm and the payload at 1 m; the others a little, N·m, [joint]."""
    return np.array([5.0, 15.0 + 9.81 * payload_kg, 4.0, 8.0, 2.0, 2.0, 1.0])


def phase(seconds: float, tau: np.ndarray, qd: float = 0.0) -> Phase:
    """The same torque and speed throughout."""
    samples = round(seconds * RATE_HZ)
    profile = np.zeros((samples, 3, JOINTS), np.float32)
    profile[:, 1], profile[:, 2] = qd, tau
    return Phase(profile, np.zeros(samples, np.float32))


def work(place: str = "bench", payload_kg: float = LIGHT, to: str | None = None) -> Work:
    """A hold at one place, or a pick and place between two."""
    places = tuple(Place(name=name, position_m=(0.5, 0.0, 0.2)) for name in (place, to) if name)
    return Work(kind="hold" if to is None else "pick_place", places=places, payload_kg=payload_kg)


@dataclass(frozen=True)
class ByPayload:
    """Finds a work as hard as its payload, each arm in its own measure."""

    measure: float
    version: str = "by payload"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        d = 1.0 - np.exp(-self.measure * (1.0 + plan.work.payload_kg) / 10.0)
        return Difficulty(np.full(JOINTS, d), p_saturation=float(d))


@dataclass(frozen=True)
class Times:
    """Seconds of the phases of every plan of an arm."""

    approach: float = 3.0
    cycle: float = 10.0
    retreat: float = 2.0


def arm(
    index: int,
    works: Sequence[Work],
    *,
    times: Times | None = None,
    model: DifficultyModel | None = None,
    motors: Motors | None = None,
    thermal: ThermalModel | None = None,
    qd: float = 0.0,
) -> Arm:
    """An arm that can do the works, nominal unless told otherwise."""
    times = times or Times()
    name = f"arm_{index}"
    plans = {}
    for each in works:
        tau = torque(each.payload_kg)
        parts = [phase(times.approach, tau), phase(times.cycle, tau, qd), phase(times.retreat, tau)]
        plans[each] = (Plan(name, each, 0, 1.0, *parts),)
    return Arm(
        robot=Robot(name=name),
        motors=motors or gen3_motors(),
        thermal=thermal or thermal_model(gen3_network()),
        rest_tau=torque(0.0) / 3.0,
        model=model or ByPayload(1.0 + 0.1 * index),
        plans=plans,
    )


def job(name: str, content: Work | None = None, **changes) -> Job:
    """Three cycles, there from the beginning."""
    base = Job(name=name, work=content or work(), repetitions=3, release_s=0.0, due_s=1e4, value=1.0)
    return replace(base, **changes)


def crowded(share: float) -> Space:
    """Space in which this share of the pairs of plans of two arms exclude each other; the same pairs at every call."""

    def space(plans: Sequence[Plan]) -> tuple[np.ndarray, np.ndarray]:
        names = [f"{plan.arm} {plan.work} {plan.duration_s(1)}" for plan in plans]
        conflicts = np.zeros((len(plans), len(plans)), bool)
        for i, j in zip(*np.triu_indices(len(plans), 1), strict=True):
            drawn = crc32("".join(sorted((names[i], names[j]))).encode()) / 2**32
            conflicts[i, j] = conflicts[j, i] = plans[i].arm != plans[j].arm and drawn < share
        return np.arange(len(plans)), conflicts

    return space


def shop(
    shifts: Sequence[Sequence[Job]],
    *,
    arms: int | Sequence[Arm] = 2,
    limits: ThermalLimits | None = None,
    dt_s: float = 10.0,
    ticks: int = 60,
    slots: int = 4,
    ambient_c: float = 25.0,
    start_warm: bool = False,
    space: Space | None = None,
    plans_per_job: int = 1,
    absences: Sequence[tuple[int, int, int, int]] = (),
) -> tuple[World, ProfilePlant]:
    """A world in which every arm can do every job (unless arms are given), and the plant that moves it."""
    if isinstance(arms, int):
        works = tuple(dict.fromkeys(j.work for jobs in shifts for j in jobs))
        arms = [arm(i, works) for i in range(arms)]
    world = build_world(
        arms,
        shifts,
        limits=limits or ThermalLimits(),
        dt_s=dt_s,
        ticks=ticks,
        slots=slots,
        ambient_c=np.full((ticks, len(arms)), ambient_c),
        start_warm=start_warm,
        space=space,
        plans_per_job=plans_per_job,
        absences=np.array(list(absences), ABSENCE),
    )
    rest_q = np.stack([a.robot.home_q() for a in arms])
    return world, ProfilePlant(world.plans, rest_q, np.stack([a.rest_tau for a in arms]))


WORKS = tuple(work(place, payload) for place in ("bench", "press", "rack") for payload in (LIGHT, WARM, HOT))


@dataclass(frozen=True)
class Shifts:
    """Makes random small shifts for an environment: mixed payloads, shared stations, precedence, heat."""

    arms: int = 3
    jobs: int = 8
    ticks: int = 40
    slots: int = 4
    ambient_c: float = 30.0
    limits: ThermalLimits = field(default_factory=ThermalLimits)
    crowding: float = 0.0
    """Share of the pairs of plans of two arms that exclude each other."""
    hard_due: float = 0.2
    """Share of the jobs that expire."""
    plans_per_job: int = 1
    absences: int = 0
    """Breaks and failures in a shift."""

    def __call__(self, seed: np.random.SeedSequence) -> Episode:
        """The episode of a seed."""
        jobs, sensors = self.drawn(seed)
        world, plant = self.shop(jobs, self.absent(seed))
        return Episode(world=world, plant=plant, twins=("by payload",) * self.arms, sensors=sensors)

    def drawn(self, seed: np.random.SeedSequence) -> tuple[list[Job], np.random.SeedSequence]:
        """The jobs of a seed, and that of its sensors."""
        jobs_seed, sensors = (np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, i)) for i in (0, 1))
        draw = np.random.default_rng(jobs_seed)
        jobs = []
        for i in range(self.jobs):
            before = (f"job_{i - 2}",) if i > 1 and draw.random() < 0.3 else ()
            release_s = float(draw.uniform(0, 0.5 * self.ticks * 10.0))
            jobs.append(
                job(
                    f"job_{i}",
                    WORKS[int(draw.integers(len(WORKS)))],
                    repetitions=int(draw.integers(1, 6)),
                    release_s=release_s,
                    due_s=release_s + 100.0,
                    value=float(draw.integers(1, 5)),
                    after=before,
                    expires=bool(draw.random() < self.hard_due),
                )
            )
        return jobs, sensors

    def absent(self, seed: np.random.SeedSequence) -> list[tuple[int, int, int, int]]:
        """Absences of a seed, which may overlap: arm, first tick, tick after the last, kind."""
        draw = np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 2)))
        begins = draw.integers(0, self.ticks, self.absences).tolist()
        return [
            (int(draw.integers(self.arms)), begin, begin + int(draw.integers(1, 9)), int(draw.integers(1, 4)))
            for begin in begins
        ]

    def shop(
        self, jobs: Sequence[Job], absences: Sequence[tuple[int, int, int, int]] = ()
    ) -> tuple[World, ProfilePlant]:
        """A world with these jobs."""
        arms = [arm(i, WORKS, times=Times(cycle=10.0 + 2.0 * i)) for i in range(self.arms)]
        return shop(
            [jobs], arms=arms, limits=self.limits, ticks=self.ticks, slots=self.slots, ambient_c=self.ambient_c,
            space=crowded(self.crowding) if self.crowding else None, plans_per_job=self.plans_per_job,
            absences=absences,
        )  # fmt: skip

    def library(self) -> Library:
        """The same shifts for a batch."""
        world, _ = self.shop([job(str(k), work, repetitions=n, value=v) for k, (work, n, v) in enumerate(KINDS)])
        return Library(world.arms, self.slots, world.tables, AsArrays(self))


KINDS = tuple((each, n, float(v)) for each in WORKS for n in range(1, 6) for v in range(1, 5))
"""Every work, number of repetitions and value that `Shifts` draws."""


@dataclass(frozen=True)
class AsArrays:
    """Draws what `Shifts` draws, for a batch."""

    shifts: Shifts

    def __call__(self, seed: np.random.SeedSequence) -> Shift:
        jobs, sensors = self.shifts.drawn(seed)
        index = {each.name: j for j, each in enumerate(jobs)}
        return Shift(
            fleet=0,
            ambient_offset_k=0.0,
            kind=np.array([KINDS.index((each.work, each.repetitions, each.value)) for each in jobs], dtype=int),
            release_s=np.array([each.release_s for each in jobs]),
            due_s=np.array([each.due_s for each in jobs]),
            repetitions=np.array([each.repetitions for each in jobs], dtype=int),
            after=np.array([[index[name] for name in each.after] or [-1] for each in jobs], dtype=int).reshape(-1, 1),
            expires=np.array([each.expires for each in jobs]),
            noise_key=key_of(sensors),
            absences=np.array(self.shifts.absent(seed), ABSENCE),
        )


@pytest.fixture(scope="session", autouse=True)
def plans(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The cache of plans and twins that all tests of a run share, in all workers; never the user's."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMOFLEET_CACHE", str(folder))
        yield folder


@pytest.fixture
def thermofleet(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., CommandResult]:
    """The command line: `thermofleet("run", path, "--seed", 3)`."""
    # A stage that is slow on a slow machine prints a line of progress; what a command prints shall not depend on that.
    monkeypatch.setattr("scenarios.terminal.AFTER_S", 1e6)

    def result(*args: object) -> CommandResult:
        code, output = call(*args), capsys.readouterr()
        return CommandResult(code, output.out, output.err)

    return result


@pytest.fixture(scope="session")
def token_reaches():
    """Waits until a client sees a token that another has just declared: it passes through the router first."""

    def wait(link, key):
        deadline_s, pause = time.monotonic() + 120.0, threading.Event()
        while not link.tokens(key):
            assert time.monotonic() < deadline_s, f"{key} was not seen"
            pause.wait(0.02)

    return wait


@pytest.fixture(scope="session")
def small() -> SimpleNamespace:
    """The makers of small worlds."""
    return SimpleNamespace(
        arm=arm,
        job=job,
        shop=shop,
        crowded=crowded,
        work=work,
        torque=torque,
        phase=phase,
        Times=Times,
        ByPayload=ByPayload,
        Shifts=Shifts,
        LIGHT=LIGHT,
        WARM=WARM,
        HOT=HOT,
    )


@pytest.fixture(scope="session")
def three_arms() -> dict[str, Any]:
    """A parsed scenario of three different arms, planned in a second and hot enough to fault; add a name and jobs."""
    home = {"home": "retract"}
    return {
        "description": "Three different arms over their limits.",
        "horizon_s": 900.0,
        "slots": 4,
        "ambient": {"points": [[0.0, 30.0], [900.0, 33.0]]},
        "limits": {"warning_c": 34.5, "error_c": 35.0, "restart_c": 34.0, "clear_s": 15.0},
        "start": "cold",
        "arms": [
            {"name": "left", "position_m": [-0.45, 0.0, 0.0], **home},
            {"name": "right", "position_m": [0.45, 0.0, 0.0], "tilt_deg": [0.0, 0.0, 180.0], "wear": 0.3, **home},
            {"name": "far", "position_m": [0.0, 1.0, 0.6], "tilt_deg": [90.0, 0.0, 0.0], **home},
        ],
        "places": [
            {"name": "bench", "position_m": [0.0, 0.2, 0.25]},
            {"name": "shelf", "position_m": [0.0, -0.2, 0.25]},
            {"name": "rack", "position_m": [0.0, 0.0, 0.3]},
        ],
        "planning": {"elbows": 1, "speeds": [1.0]},
    }


@pytest.fixture(scope="session")
def job_streams() -> Callable[..., dict[str, dict[str, Any]]]:
    """A function of job streams for `three_arms`, by name."""

    def make(hold_until_s: float, sort_until_s: float | None, sort_due_s: float) -> dict[str, dict[str, Any]]:
        stop = {} if sort_until_s is None else {"stop_s": sort_until_s}
        return {
            "hold": {
                "name": "hold", "kind": "hold", "places": ["bench"], "payload_kg": [3.0, 4.0], "repetitions": [2, 4],
                "dwell_s": 15.0, "arrivals": {"kind": "poisson", "every_s": 60.0, "stop_s": hold_until_s},
                "value": 3.0, "due_s": 120.0,
            },
            "sort": {
                "name": "sort", "kind": "sort", "places": ["shelf", "rack"], "payload_kg": [0.2, 0.5],
                "repetitions": [1, 3], "arrivals": {"kind": "poisson", "every_s": 40.0, **stop}, "due_s": sort_due_s,
            },
            "check": {
                "name": "check", "kind": "press", "places": ["rack"], "force_n": 20.0, "dwell_s": 4.0,
                "arrivals": {"kind": "batch", "count": 3, "start_s": 60.0}, "after": ["sort"], "value": 2.0,
            },
        }  # fmt: skip

    return make
