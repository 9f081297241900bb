"""A fleet on a thread whose arms move, warm and do jobs."""

import math
import time
from contextlib import ExitStack

from fleet.bus.client import BusClient
from fleet.bus.protocol import auction as bus
from fleet.bus.protocol import keys
from fleet.bus.protocol.cell import Cell, CellArm, CellKind, CellPlace, CellRequest, Limit, PlannedWork
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.bus.protocol.operator import (
    Cancel,
    Change,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Operation,
    Pause,
    ResetReply,
    ResetRequest,
    Settle,
)
from fleet.errors import Refused, RefusedForNow
from fleet.job import BOUNDS
from tests.waiting import serving

WARNING_C, ERROR_C = 60.0, 75.0
PLACES = ("conveyor", "pallet", "clamp")


class MovingFleet:
    """`with MovingFleet(endpoint, ("arm_0", "arm_1")) as fleet:` publishes until the end of the block.

    Attributes:
        requests: Every request of a person, in order.
        temp_c: Temperature of joint 2, by arm.
        mode: Mode of each arm.
        jobs: Status of every job by name.
    """

    def __init__(self, endpoint, arms=("arm_0", "arm_1"), fleet="cell", rate_hz=10.0, cycle_s=0.3, *, auctioneer=""):
        """Prepare; `auctioneer` is an endpoint of its own for the auctioneer."""
        self.link, self.fleet, self.arms, self.rate_hz = BusClient(endpoint, fleet), fleet, arms, rate_hz
        self.boss = BusClient(auctioneer, fleet) if auctioneer else self.link
        self.requests, self.jobs, self.paused = [], {}, {}
        self.temp_c = {arm: 35.0 + 6.0 * i for i, arm in enumerate(arms)}
        self.mode = dict.fromkeys(arms, "idle")
        self.work = {}  # job by arm, and the real second at which its next cycle ends
        self.cycle_s, self.number, self.tick = cycle_s, 0, 0
        self.due_s, self.thread = 0.0, ExitStack()
        self.ahead_s = 0.0  # of the clock, since a motor that warms at once has a bad sensor

    def __enter__(self):
        link, boss, fleet = self.link.open(), self.boss.open(), self.fleet
        self.start_s = time.monotonic()
        self.states = {arm: link.publisher(keys.of_arm(fleet, arm, "state"), State) for arm in self.arms}
        self.scores = {
            arm: link.publisher(keys.of_arm(fleet, arm, "difficulty"), DifficultyScores) for arm in self.arms
        }
        self.events = {arm: link.publisher(keys.of_arm(fleet, arm, "event"), bus.ArmEvent) for arm in self.arms}
        self.results = boss.publisher(keys.of_auction(fleet, "auctioneer", "result"), bus.Result)
        self.operations = boss.publisher(keys.of_auction(fleet, "auctioneer", "operation"), Operation)
        for arm in self.arms:
            link.declare_token(keys.of_arm(fleet, arm, "alive"))
            link.reply_to(keys.of_arm(fleet, arm, "quote"), bus.QuoteRequest, lambda r, arm=arm: self.quote(arm, r))
            link.reply_to(keys.of_arm(fleet, arm, "reset"), ResetRequest, lambda r, arm=arm: self.reset(arm, r))
        boss.declare_token(keys.of_auction(fleet, "auctioneer", "alive"))
        boss.reply_to(keys.of_jobs(fleet, "submit"), bus.Submission, lambda request: self.submit(request))
        boss.reply_to(keys.of_jobs(fleet, "status"), bus.StatusRequest, self.status)
        boss.reply_to(keys.of_jobs(fleet, "control"), ControlRequest, self.control)
        boss.reply_to(keys.of_jobs(fleet, "clear"), ClearRequest, self.clear)
        boss.reply_to(keys.of_jobs(fleet, "cell"), CellRequest, lambda _: self.cell())
        boss.reply_to(keys.of_clock(fleet), bus.ClockRequest, lambda _: bus.Clock(self.now(), 1.0))
        self.thread.enter_context(serving(*dict.fromkeys((link, boss)), meanwhile=self.move))
        return self

    def __exit__(self, *_):
        self.thread.close()
        self.link.close()
        self.boss.close()

    def now(self):
        return time.monotonic() - self.start_s + self.ahead_s

    def move(self):
        """Publish the state of every arm, and continue the jobs, if the time has come."""
        if time.monotonic() < self.due_s:
            return
        self.due_s = time.monotonic() + 1.0 / self.rate_hz
        self.tick += 1
        now_s = self.now()
        for i, arm in enumerate(self.arms):
            job = self.work.get(arm, ("", 0.0))[0]
            swing = math.sin(now_s + i)
            q = (swing, 0.4 + 0.3 * swing, 3.1, -2.0 + 0.4 * swing, 0.0, 0.9, 1.57)
            temp_c = (30.0, self.temp_c[arm], 31.0, 33.0, 29.0, 28.0, 27.0)
            status = self.jobs.get(job)
            left = {} if status is None else {"job_peak_c": self.temp_c[arm] + 3.0, "job_p_saturation": 0.05}
            self.states[arm](
                State(arm=arm, tick=self.tick, time_s=now_s, mode=self.mode[arm], temp_c=temp_c, job=job, q=q,
                      headroom_k=WARNING_C - self.temp_c[arm], qd=(0.1,) * 7, tau=(1.0,) * 7, current_a=(0.2,) * 7,
                      housing_c=(25.0,) * 7, ambient_c=22.0, **left)
            )  # fmt: skip
        if self.tick % 5 == 1:
            self.score()
        self.progress()

    def score(self):
        names = tuple(name for name, status in self.jobs.items() if status.state == "waiting")
        for i, arm in enumerate(self.arms):
            peaks = tuple(self.temp_c[arm] + 4.0 + i for _ in names)
            d, p = tuple(0.2 + 0.1 * i for _ in names), tuple(0.01 * (i + 1) for _ in names)
            self.scores[arm](DifficultyScores(arm, self.tick, self.now(), "twin", names, d, p, peaks))

    def progress(self):
        real_s = time.monotonic()
        for arm, (job, due_s) in list(self.work.items()):
            status = self.jobs[job]
            if status.state == "cancelled" or arm in self.paused:
                self.end(arm)
            elif real_s >= due_s:
                cycles, total = status.cycles + 1, status.repetitions
                self.work[arm] = job, real_s + self.cycle_s
                if cycles == total:
                    self.set(job, state="finished", arm=arm, cycles=cycles, repetitions=total, finished_s=self.now())
                    self.end(arm)
                else:
                    self.jobs[job] = bus.JobStatus(
                        job, "awarded", arm, "a", cycles, repetitions=total, finish_s=self.now() + total - cycles
                    )
        free = [a for a in self.arms if a not in self.work and self.mode[a] == "idle" and a not in self.paused]
        waiting = [name for name, status in self.jobs.items() if status.state == "waiting"]
        for arm, job in zip(free if "*" not in self.paused else (), waiting, strict=False):
            if self.tick % 10 == 0:  # after some scores
                self.mode[arm], self.work[arm] = "working", (job, real_s + self.cycle_s)
                self.set(job, state="awarded", arm=arm, award="a", repetitions=self.jobs[job].repetitions, cycles=0)

    def end(self, arm):
        del self.work[arm]
        self.mode[arm] = "idle"

    def set(self, job, by="", **fields):
        self.jobs[job] = status = bus.JobStatus(job, **fields)
        self.number += 1
        scores = {"difficulty": 0.2, "p_saturation": 0.01, "peak_c": 41.0} if status.state == "awarded" else {}
        self.results(bus.Result("auctioneer", self.number, self.now(), status, by=by, **scores))

    def post(self, call):
        """Call on the thread of the fleet."""
        self.link.post(call)

    def happens(self, number, reason=""):
        """Publish an event of the first arm."""
        arm = self.arms[0]
        self.events[arm](bus.ArmEvent(arm=arm, number=number, time_s=1.0, kind="warning", joint=2, reason=reason))

    # Requests

    def cell(self):
        work = PlannedWork("pick_place", ("conveyor", "pallet"), 1.5, 2, 9.6, 0.5)
        places = tuple(CellPlace(name, (0.4, 0.3 * i, 0.2), (180.0, 0.0, 0.0), 0.08) for i, name in enumerate(PLACES))
        arms = tuple(
            CellArm(arm, (1.6 * (i % 4), 1.6 * (i // 4), 0.0), (0.0, 0.0, 0.0), 3.0, 0.5, 0.902, (work,))
            for i, arm in enumerate(self.arms)
        )
        kinds = (CellKind("pick_place", 2, "Take the payload to the second place."), CellKind("hold", 1, "Hold it."))
        fields = ("payload_kg", "force_n", "dwell_s", "repetitions", "due_s", "value")
        limits = {name: Limit(*BOUNDS[name]) for name in fields}
        return Cell("auctioneer", "packing", places, arms, kinds, limits, WARNING_C, ERROR_C, 128)

    def quote(self, arm, request):
        i = self.arms.index(arm)
        plan = bus.PlanQuote(peak_c=self.temp_c[arm] + 4, p_saturation=0.01, difficulty=0.2 + i, finish_in_s=30.0)
        offers = tuple(bus.JobEstimate(job.name, (plan,)) for job in request.jobs)
        return bus.Quote(arm, request.auction, "", 3.0, "t", self.now(), self.mode[arm], 20.0, 1, offers)

    def submit(self, request):
        if request.by == "disk full":
            raise RefusedForNow("The journal has no room.")
        if request.by == "nobody":
            raise Refused("There is no 'nobody'.")
        self.requests.append(request)
        for job in request.jobs:
            self.set(job.name, request.by, state="waiting", repetitions=job.repetitions)
        return bus.SubmissionReply("auctioneer", tuple(bus.Admission(job.name, True) for job in request.jobs))

    def status(self, request):
        return bus.Status("auctioneer", self.now(), tuple(self.jobs.values())[-100:], paused=self.paused)

    def control(self, request):
        self.requests.append(request)
        action, status = request.action, None
        if isinstance(action, Cancel | Settle | Change):
            if action.job not in self.jobs:
                raise Refused(f"There is no job '{action.job}'.")
            status = self.jobs[action.job]
            state = {Cancel: "cancelled", Settle: "finished", Change: status.state}[type(action)]
            self.set(action.job, request.by, state=state, repetitions=status.repetitions, cycles=status.cycles)
            status = self.jobs[action.job]
        elif isinstance(action, Pause):
            self.paused[action.arm] = request.by
        else:
            self.paused.pop(action.arm, None)
        self.operations(Operation("auctioneer", self.now(), request))
        return Controlled("auctioneer", request.request, True, "It is so.", status, dict(self.paused))

    def clear(self, request):
        self.requests.append(request)
        return Cleared("auctioneer", request.arm)

    def reset(self, arm, request):
        self.requests.append(request)
        changed, self.mode[arm] = self.mode[arm] == "faulted", "idle"
        return ResetReply(arm, changed)
