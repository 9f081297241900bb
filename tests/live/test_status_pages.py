"""The status of more jobs than one message has: in pages, with the most urgent jobs first."""

from collections import Counter
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from benchmarks.simulation.participants import CLIENT
from fleet.bus.client import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import MOST_JOBS, JobSpec, JobState, JobStatus, Status, StatusRequest
from fleet.bus.protocol.messages import MOST_BYTES, State, encode
from fleet.errors import Refused
from fleet.live import job_client
from fleet.live.job_client import query_statuses
from fleet.live.job_rules import finish_s
from fleet.live.records import JobEntry
from tests.live.many_jobs import ManyJobs, entries
from tests.waiting import PATIENCE_S

STATES = get_args(JobState)
STATUS = keys.of_jobs("f", "status")


def pages(desk, names=(), between=lambda: None):
    """Read all pages of a desk; call `between` after each."""
    page = desk.reply(StatusRequest(names))
    read = [page]
    while page.next:
        between()
        page = desk.reply(StatusRequest(names, page.next))
        read.append(page)
    return read


def test_the_first_page_has_unfinished_jobs_then_open_ones_then_the_newest_ended_ones():
    ended, waiting = entries(300), entries(20, "waiting")
    shift = JobEntry("shift", state="unfinished", shift_ended=True)
    few = [*entries(3, "unfinished"), *entries(2, "awarded"), *entries(1, "finishing")]
    read = pages(desk := ManyJobs(*ended, shift, *waiting, *few))
    listed = [status.job for page in read for status in page.jobs]
    first = [*(f"unfinished_{n:04d}" for n in range(3)), "awarded_0000", "awarded_0001", "finishing_0000"]
    first += [f"waiting_{n:04d}" for n in range(20)]
    assert listed == [*first, *(f"finished_{n:04d}" for n in reversed(range(300))), "shift"]
    assert [len(page.jobs) for page in read] == [128, 128, 71]
    assert all(page.counts == Counter(entry.state for entry in desk.entries.values()) for page in read)
    (named,) = pages(desk, ("shift", "awarded_0001", "?"))
    assert [status.job for status in named.jobs] == ["awarded_0001", "shift"]
    assert named.counts["finished"] == 300


def test_the_finish_is_unknown_of_an_arm_that_does_not_say_how_long_it_is_busy():
    status = JobStatus("a", "awarded", "x")
    state = State("x", 1, 100.0, "working", (40.0,), 20.0, job="a")
    assert finish_s(status, state, 101.0) is None
    assert finish_s(status, replace(state, busy_s=30.0), 101.0) == 130.0
    assert finish_s(status, replace(state, busy_s=30.0, job="b"), 101.0) is None


def test_the_finish_of_an_arm_whose_clock_is_ahead_counts_from_fleet_time():
    state = State("x", 1, 5100.0, "working", (40.0,), 20.0, job="a", busy_s=30.0)
    assert finish_s(JobStatus("a", "awarded", "x"), state, 101.0) == 131.0


def test_waiting_jobs_come_in_the_order_of_their_release():
    jobs = [JobEntry(f"j{n}", JobSpec(f"j{n}", "hold", ("a",), release_s=100.0 - n)) for n in range(9)]
    (page,) = pages(ManyJobs(*jobs))
    assert [status.job for status in page.jobs] == [f"j{n}" for n in reversed(range(9))]


@given(
    st.lists(st.sampled_from(STATES), min_size=1, max_size=40),
    st.lists(st.tuples(st.integers(0, 39), st.sampled_from(STATES)), max_size=20),
    st.integers(1, 7),
)
def test_a_job_that_does_not_change_is_on_one_page(states, changes, size):
    """Any jobs, of which one changes its state after each page."""
    desk = ManyJobs(*(JobEntry(f"a job {n}", state=state, settled_s=n / 3) for n, state in enumerate(states)))
    todo = [(f"a job {n}", state) for n, state in changes if n < len(states)]
    moved = set()

    def change():
        if todo:
            name, state = todo.pop()
            moved.add(name)
            desk.move(name, state)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fleet.live.desk.MOST_JOBS", size)
        listed = Counter(status.job for page in pages(desk, between=change) for status in page.jobs)
    assert all(listed[name] == 1 for name in desk.entries.keys() - moved)


def test_a_page_fits_into_a_message_with_the_longest_names_and_reasons():
    long = [
        JobEntry(f"{'é' * 120}{n}", JobSpec(f"{'é' * 120}{n}", "hold", ("a",)), reason="x" * 700) for n in range(200)
    ]
    desk = ManyJobs(*long)
    desk.book.space = {f"arm_{number}": frozenset("*") for number in range(1000)}
    read = pages(desk)
    assert all(len(encode(page)) < MOST_BYTES and page.jobs and len(page.space) == 1000 for page in read)
    assert sum(len(page.jobs) for page in read) == 200


def test_a_page_without_room_for_a_job_is_no_last_one():
    desk = ManyJobs(*entries(1))
    desk.book.space = {f"arm_{number}": frozenset([16 * "0", 16 * "1"]) for number in range(1200)}
    page = desk.reply(StatusRequest())
    assert (page.jobs, page.counts, page.next != "") == ((), {"finished": 1}, True)


@pytest.mark.parametrize("after", ["x", "3", "3 x job", "nan"])
def test_a_position_that_no_reply_has_is_refused(after):
    with pytest.raises(Refused, match=r"StatusRequest\.after must be `next` of a reply"):
        ManyJobs(*entries(1)).reply(StatusRequest((), after))


def test_every_kind_of_fleet_tells_the_state_of_all_jobs_and_why_they_wait(fleet):
    """With an auctioneer, and without one."""
    jobs = [JobSpec(f"j{number}", "hold", ("a",), release_s=1e6 * (number % 2)) for number in range(300)]
    for first in range(0, 300, MOST_JOBS):
        fleet.submit(*jobs[first : first + MOST_JOBS])
    replies: list[Any] = []
    client = fleet.world.processes[CLIENT].client
    fleet.call(CLIENT, lambda: query_statuses(client, replies.append, timeout_s=5.0))
    fleet.until(lambda: bool(replies))
    status = replies[0].first(STATUS)
    assert {each.job for each in status.jobs} == {job.name for job in jobs}
    assert (status.next, sum(status.counts.values())) == ("", 300)
    assert sum(each.state == "waiting" and bool(each.reason) for each in status.jobs) == status.counts["waiting"]


class Link:
    """A link to one participant that replies at once, without a network."""

    fleet = "f"

    def __init__(self, reply):
        self._reply = reply

    def query(self, key, request, kind, done, *, timeout_s):
        try:
            done(Replies({key: self._reply(request)}))
        except Refused as refusal:
            done(Replies(refused={key: str(refusal)}))


def read_all(reply, names=(), **options) -> Status:
    replies = []
    query_statuses(Link(reply), replies.append, names, timeout_s=PATIENCE_S, **options)
    return replies[0].first(STATUS)


def test_a_client_reads_all_pages_as_one_reply_and_stops_after_enough_jobs_or_pages(monkeypatch):
    desk = ManyJobs(*entries(399), *entries(1, "unfinished"))
    status = read_all(desk.reply)
    assert (len(status.jobs), status.next, status.jobs[0].state) == (400, "", "unfinished")
    assert status.counts == {"finished": 399, "unfinished": 1}
    assert len(read_all(desk.reply, [*desk.entries][:300]).jobs) == 300
    status = read_all(desk.reply, most=129)
    assert (len(status.jobs), status.next != "") == (256, True)
    monkeypatch.setattr(job_client, "MAX_PAGES", 1)
    assert len(read_all(desk.reply).jobs) == MOST_JOBS


def test_a_client_has_what_arrived_if_a_page_is_refused():
    """And what a participant repeats without an end, or without a job."""
    first = Status("au", 1.0, ManyJobs(*entries(2)).reply(StatusRequest()).jobs, counts={"finished": 9}, next="3 1.0 x")

    def refuse(request):
        if request.after:
            raise Refused("It has no more.")
        return first

    for reply, count in ((refuse, 2), (lambda _: first, 2), (lambda _: Status("au", 1.0, (), next="3 1.0 x"), 0)):
        status = read_all(reply)
        assert (len(status.jobs), status.next) == (count, "3 1.0 x")
