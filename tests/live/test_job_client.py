"""A client that submits jobs and follows them, beside an auctioneer that says what the test wants."""

import threading
from contextlib import ExitStack, contextmanager

import pytest

from fleet.bus.client import BusClient, NoReply, Refused
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Admission,
    JobSpec,
    JobStatus,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.operator import Controlled, ControlRequest
from fleet.bus.router import Router
from fleet.live import job_client
from fleet.live.job_client import JobClient
from tests.waiting import serve_until

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


def test_to_ask_gets_a_reply_a_refusal_or_none(place, threads):
    here = place(by="mallory")
    with threads(lambda: here.other.serve()):
        with pytest.raises(Refused, match="No room"):
            here.client.submit_and_wait([JOB])
        key = keys.of_jobs("f", "status")
        assert here.link.ask(key, StatusRequest(), Status, timeout_s=5.0).auctioneer == "boss"
    with pytest.raises(NoReply, match="in time"):
        here.link.ask(key, StatusRequest(), Status, timeout_s=0.1)
    here.other.close()
    with pytest.raises(NoReply, match="There is no auctioneer in this fleet"):
        here.link.ask(key, StatusRequest(), Status, timeout_s=0.1, attempts=2)


@pytest.fixture
def threads():
    @contextmanager
    def run(turn):
        stop = threading.Event()

        def loop():
            while not stop.wait(0.005):
                turn()

        thread = threading.Thread(target=loop)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    return run
