"""A client that submits jobs and follows them, and what the status of a job says in each state."""

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from fleet.bus.client import BusClient, NoReply, Refused
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    NOT_PLANNED,
    Admission,
    JobEstimate,
    JobSpec,
    JobStatus,
    PlanQuote,
    Quote,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.operator import Controlled, ControlRequest
from fleet.bus.router import Router
from fleet.live import job_client
from fleet.live.auction.rounds import planned_jobs
from fleet.live.job_client import JobClient
from tests import commands
from tests.waiting import PATIENCE_S, serve_until, serving

JOB = JobSpec("a", "hold", ("rack",))


class Auctioneer:
    """Accepts every job but those named `bad`, and knows their states."""

    def __init__(self, link, *, token=True):
        self.link, self.states, self.asked, self.controls = link, {}, 0, []
        link.reply_to(keys.of_jobs("f", "submit"), Submission, self._submit)
        link.reply_to(keys.of_jobs("f", "status"), StatusRequest, self._status)
        link.reply_to(keys.of_jobs("f", "control"), ControlRequest, self._control)
        self._result = link.publisher(keys.of_auction("f", "boss", "result"), Result)
        if token:
            link.declare_token(keys.of_auction("f", "boss", "alive"))

    def _submit(self, request):
        if request.by == "mallory":
            raise Refused("No room.")
        self.states |= {job.name: JobStatus(job.name, "waiting") for job in request.jobs if job.name != "bad"}
        admissions = (Admission(j.name, j.name != "bad", "no such place" * (j.name == "bad")) for j in request.jobs)
        return SubmissionReply("boss", tuple(admissions))

    def _status(self, request):
        self.asked += 1
        return Status("boss", 0.0, tuple(self.states[job] for job in request.jobs if job in self.states))

    def _control(self, request):
        self.controls.append(request)
        self.publish(JobStatus(request.action.job, "cancelled"))
        return Controlled("boss", request.request, changed=True)

    def publish(self, status):
        self.states[status.job] = status
        self._result(Result("boss", len(self.states), 1.0, status))


class Place:
    """A client of jobs and an auctioneer, served by one thread."""

    def __init__(self, endpoint, stack, *, token=True, by="ann"):
        self.link, self.other = (stack.enter_context(BusClient(endpoint, "f")) for _ in range(2))
        self.boss, self.seen = Auctioneer(self.other, token=token), []
        self.client = JobClient(self.link, by, self.seen.append)

    def serve(self, until_s=None):
        self.client.step()
        self.link.serve()

    def until(self, done):
        serve_until(done, self, self.other)

    def states(self):
        return [(status.job, status.state) for status in self.seen]


@pytest.fixture
def place():
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        yield lambda **options: Place(router.endpoint, stack, **options)


def test_a_job_is_followed_by_its_results_with_hardly_a_question(place, monkeypatch):
    monkeypatch.setattr(job_client, "STATUS_S", (0.01, 3600.0))
    here = place()
    here.until(lambda: here.client._auctioneers)
    here.client.submit(JOB)
    here.until(lambda: here.boss.asked == 1)  # once after the admission: it may be an old job
    for state in ("awarded", "finishing", "finished"):
        here.boss.publish(JobStatus("a", state, "arm_0"))
        here.until(lambda state=state: here.seen and here.seen[-1].state == state)
    assert here.states() == [("a", "awarded"), ("a", "finishing"), ("a", "finished")]
    assert (here.client.open, here.boss.asked) == ([], 1)


def test_without_an_auctioneer_the_state_is_asked_for(place, monkeypatch):
    monkeypatch.setattr(job_client, "STATUS_S", (0.01, 3600.0))
    here = place(token=False)
    here.client.submit(JOB)
    here.until(lambda: here.boss.asked > 3)
    here.boss.states["a"] = JobStatus("a", "finished", "arm_0")
    here.until(lambda: not here.client.open)
    assert here.states() == [("a", "finished")]


def test_a_job_that_is_not_accepted_ends_with_the_reason(place):
    here = place()
    here.client.submit(JobSpec("bad", "hold", ("nowhere",)))
    here.until(lambda: here.seen)
    assert here.seen == [JobStatus("bad", "given_up", reason="not accepted: no such place")]


def test_a_job_is_cancelled_once_it_is_submitted(place):
    here = place()
    here.client.submit(JOB)
    assert here.client.cancel("b") == "There is no job 'b'."
    assert here.client.cancel("a") == here.client.cancel("a") == ""
    here.until(lambda: not here.client.open)
    assert [request.action.job for request in here.boss.controls] == ["a"] * len(here.boss.controls)
    assert {(request.request, request.by) for request in here.boss.controls} == {(here.boss.controls[0].request, "ann")}


def test_whoever_forgets_a_job_hears_no_more_of_it(place):
    here = place()
    here.client.follow(["a"])
    here.boss.publish(JobStatus("a", "waiting"))
    here.until(lambda: here.seen)
    here.client.forget("a")
    here.boss.publish(JobStatus("a", "finished"))
    here.client.follow(["b"])
    here.boss.publish(JobStatus("b", "finished"))
    here.until(lambda: ("b", "finished") in here.states())
    assert here.states() == [("a", "waiting"), ("b", "finished")]


def test_to_ask_gets_a_reply_a_refusal_or_none(place):
    here, key = place(by="mallory"), keys.of_jobs("f", "status")
    with serving(here.other):
        assert here.link.wait_for_queryable(key, PATIENCE_S)  # the other one was declared before
        with pytest.raises(Refused, match="No room"):
            here.client.submit_and_wait([JOB])
        assert here.link.ask(key, StatusRequest(), Status, timeout_s=PATIENCE_S).auctioneer == "boss"
    with pytest.raises(NoReply, match="in time"):  # the thread may still have dropped a first request
        here.link.ask(key, StatusRequest(), Status, timeout_s=0.1, attempts=3)
    here.other.close()
    with pytest.raises(NoReply, match="No auctioneer is online in this fleet"):
        here.link.ask(key, StatusRequest(), Status, timeout_s=PATIENCE_S)


def test_a_job_is_planned_once_an_arm_has_a_plan_or_every_arm_has_none():
    def quote(arm: str, **reasons: str) -> Quote:
        estimates = (JobEstimate(name, (PlanQuote(),) if not why else (), why) for name, why in reasons.items())
        return Quote(arm, "r", "q", 3.0, "t", 0.0, "idle", 9.0, 1, tuple(estimates))

    one = quote("a", x="", y=NOT_PLANNED, z="too far", w=NOT_PLANNED)
    other = quote("b", x=NOT_PLANNED, y=NOT_PLANNED, z="too heavy", w="too far")
    assert planned_jobs({"a": one, "b": other}) == {"x", "z"}


ROOT = Path(__file__).parents[2]
JOBS = [{"name": name, "kind": "hold", "places": ["fixture"], "dwell_s": 5.0} for name in ("one", "two", "three")]


@pytest.fixture
def port(tmp_path):
    """The port of a router with the auctioneer of quickstart, whose arms are absent: every job waits."""
    with Router() as router:
        at = ("--fleet", "f", "--endpoint", router.endpoint, "--journal", str(tmp_path / "j"), "--jobs", "none")
        auction = commands.start("bus", "auctioneer", "quickstart", *at, stderr=None)
        try:
            assert auction.stdout is not None
            assert auction.stdout.readline().startswith("ready")
            yield int(router.endpoint.rsplit(":", 1)[1])
        finally:
            auction.terminate()
            auction.communicate(timeout=300)


def told(done: subprocess.CompletedProcess[str]) -> tuple[int, str]:
    return done.returncode, done.stdout + done.stderr


@pytest.mark.ci_slow
def test_the_commands_and_the_example_steer_a_fleet(port, tmp_path):
    def command(*words):
        return told(commands.run(*words, "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}"))

    def example(*words):
        steer = [sys.executable, str(ROOT / "examples" / "steer_jobs.py"), str(port), "f", *words]
        return told(subprocess.run(steer, capture_output=True, text=True, timeout=300, check=False))

    (tmp_path / "jobs.json").write_text(json.dumps(JOBS), encoding="utf-8")
    code, said = command("job", "submit", tmp_path / "jobs.json")
    assert (code, said.count("accepted")) == (0, 3)
    assert command("arm", "pause", "--by", "ann") == (0, "Paused: all arms.\n")
    assert command("arm", "pause", "arm_0", "--end")[0] == 2
    assert command("job", "cancel", "one") == (0, "one: cancelled, 0 of 1 cycles.\n")
    assert command("job", "cancel", "one") == (0, "one: cancelled, 0 of 1 cycles. It is cancelled.\n")
    changed = "two: waiting, 0 of 1 cycles, due at 0:15:00, value 3.\n"
    assert command("job", "change", "two", "--due", 900, "--value", 3) == (0, changed)
    code, said = command("job", "settle", "two", "done")
    assert (code, "only an unfinished job can be settled" in said) == (2, True), said
    code, said = example("cancel", "two")
    assert code == 0
    assert '"state": "cancelled"' in said
    code, said = example("follow", "one", "two")
    assert (code, said.count("cancelled")) == (1, 2), said
    said = (example("cancel", "three"), example("settle", "three", "redo"))[1][1]
    assert said.count("refused: 'three' is cancelled") == 1, said  # a final refusal is not repeated
    code, said = example("cell")
    assert code == 0
    (cell,) = json.loads(said)
    assert {place["name"] for place in cell["places"]} >= {"fixture", "belt", "bin"}
    assert [arm["name"] for arm in cell["arms"]] == [f"arm_{i}" for i in range(4)]
    assert cell["limits"]["payload_kg"] == {"low": 0.0, "high": 10.0, "unit": "kg"}
    assert example("pause", "arm_1") == (0, 'pause {"paused": {"*": "ann", "arm_1": "steer_jobs.py"}}\nchanged \n')
    assert example("resume") == (0, 'resume {"paused": {}}\nchanged \n')
    assert command("arm", "pause", "--end") == (0, "Paused: none. Nothing changed: it is so already.\n")
