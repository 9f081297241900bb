"""`thermofleet job submit` and `ask`, and the files of jobs that they read."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Admission,
    JobEstimate,
    JobSpec,
    JobStatus,
    PlanQuote,
    Quote,
    QuoteRequest,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.errors import FleetError
from fleet.live.job_client import batches
from scenarios.live.requests import read_jobs
from tests.waiting import PATIENCE_S

HOLD = {"name": "a", "kind": "hold", "places": ["rack"], "repetitions": 2}


def test_jobs_are_read_from_lines_or_a_list(tmp_path):
    other = {**HOLD, "name": "b"}
    lines, listed = tmp_path / "jobs.jsonl", tmp_path / "jobs.json"
    lines.write_text(f"{json.dumps(HOLD)}\n\n{json.dumps(other)}\n", encoding="utf-8")
    listed.write_text(json.dumps([HOLD, other], indent=1), encoding="utf-8")
    assert [word.name for word in read_jobs(str(lines))] == ["a", "b"]
    assert read_jobs(str(lines)) == read_jobs(str(listed))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"{json.dumps(HOLD)}\n{{}}", "line 2: Object missing required field `name`."),
        (json.dumps(HOLD | {"repetitions": 0}), "line 1: JobSpec.repetitions must be between 1 and 100000 (got 0)."),
        (
            json.dumps([HOLD, HOLD | {"kind": "dance"}]),
            "No kind of job 'dance'. Allowed: hold, pick_place, press, sort (at [1].kind).",
        ),
        (json.dumps(HOLD | {"places": ["a", "b"]}), "line 1: JobSpec.places must be one place for a hold (got a, b)."),
        ("{", "line 1: Input data was truncated."),
        ("\n", "contains no jobs."),
        ("[]", "contains no jobs."),
        ("\xff", "line 1: "),
    ],
)
def test_an_invalid_job_is_reported_with_its_line(tmp_path, text, complaint):
    file = tmp_path / "jobs"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(FleetError) as refusal:
        read_jobs(str(file))
    assert str(refusal.value).startswith(f"{file}")
    assert complaint in str(refusal.value)


def test_jobs_in_several_messages_follow_those_they_wait_for():
    words = [JobSpec(f"j{i:03d}", "hold", ("x",), after=(f"j{i + 1:03d}",) if i < 199 else ()) for i in range(200)]
    handed_in = list(batches(words))
    assert [len(part) for part in handed_in] == [64, 64, 64, 8]
    assert [word.name for part in handed_in for word in part] == [word.name for word in reversed(words)]
    ring = [JobSpec("a", "hold", ("x",), after=("b",)), JobSpec("b", "hold", ("x",), after=("a",))]
    assert list(batches(ring)) == [tuple(ring)]


def test_a_missing_file_is_one_sentence(thermofleet):
    code, _, err = thermofleet("job", "submit", "no-such-file", "--fleet", "f")
    assert code == 2
    assert "Cannot read 'no-such-file': No such file or directory." in err


def test_a_missing_auctioneer_is_one_sentence(endpoint, tmp_path, thermofleet):
    file = tmp_path / "jobs"
    file.write_text(json.dumps(HOLD))
    code, _, err = thermofleet("job", "submit", file, "--endpoint", endpoint, "--fleet", "f")
    assert code == 2
    assert "No auctioneer of fleet 'f' replied" in err


@contextmanager
def served(endpoint: str, declare: Callable[[BusClient], None]) -> Iterator[None]:
    """A participant of fleet f on a thread of its own."""
    stop = threading.Event()
    with BusClient(endpoint, "f") as link:
        declare(link)

        def serve() -> None:
            while not stop.is_set():
                link.serve(time.monotonic() + 0.05)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(PATIENCE_S)


@contextmanager
def arm(endpoint: str, *, feasible: bool = True) -> Iterator[list[QuoteRequest]]:
    """An arm that only quotes; gives what it was asked."""
    asked: list[QuoteRequest] = []

    def answer(request: QuoteRequest) -> Quote:
        asked.append(request)
        fastest = PlanQuote(0, 52.34, 12.34, 0.125, (0.5,) * 7, 3.5, 100.0, 160.0)
        offers = (JobEstimate(request.jobs[0].name, (fastest, PlanQuote(1, 49.5)) if feasible else ()),)
        return Quote("arm_0", request.auction, "", 5.0, "t", 0.0, "idle", 20.0, 1, offers)

    with served(endpoint, lambda link: link.reply_to(keys.of_arm("f", "arm_0", "quote"), QuoteRequest, answer)):
        yield asked


@pytest.mark.parametrize(("end", "link", "code"), [("finished", "by", 0), ("unfinished", "last at", 1)])
def test_jobs_can_be_followed_to_their_end(endpoint, tmp_path, thermofleet, end, link, code):
    states = iter([JobStatus("a", "waiting"), JobStatus("a", "awarded", "arm_0"), JobStatus("a", end, "arm_0")])

    def declare(bus: BusClient) -> None:
        taken = SubmissionReply("auctioneer", (Admission("a", True),))
        bus.reply_to(keys.of_jobs("f", "submit"), Submission, lambda _: taken)
        bus.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: Status("auctioneer", 0.0, (next(states),)))

    file = tmp_path / "jobs"
    file.write_text(json.dumps(HOLD))
    with served(endpoint, declare):
        said = thermofleet("job", "submit", file, "--wait", "--endpoint", endpoint, "--fleet", "f")
    assert said[:2] == (code, f"a: accepted\na: waiting\na: awarded to arm_0\na: {end} {link} arm_0\n")


def test_ask_shows_the_cost_of_a_job_for_each_arm(endpoint, thermofleet):
    job = ("--kind", "hold", "--place", "rack", "--payload", "2")
    with arm(endpoint) as asked:
        code, out, _ = thermofleet("job", "submit", "--quote", *job, "--endpoint", endpoint, "--fleet", "f")
        assert code == 0
        assert "hold  arm_0     0     52.3     +12.3  0.12  3.50         100          160" in out
        assert "1     49.5         –     –     –           –            –" in out
        code, out, _ = thermofleet("job", "submit", "--quote", *job, "--endpoint", endpoint, "--fleet", "f", "--json")
        assert json.loads(out)[0]["estimates"][0]["plans"][0]["difficulty"] == 3.5
    assert [request.dry_run for request in asked] == [True, True]
    assert asked[0].jobs[0].payload_kg == 2.0


def test_ask_exits_with_1_where_no_arm_can_do_a_job(endpoint, thermofleet):
    with arm(endpoint, feasible=False):
        at = ("--endpoint", endpoint, "--fleet", "f")
        code, out, _ = thermofleet("job", "submit", "--quote", "--kind", "hold", "--place", "rack", *at)
        assert (code, "arm_0" in out) == (1, True)
        assert thermofleet("job", "submit", "--quote", "--kind", "hold", "--place", "rack", "--json", *at)[0] == 1


def test_ask_reports_missing_arguments(endpoint, thermofleet):
    at = ("--endpoint", endpoint, "--fleet", "f")
    assert "either a FILE of jobs or one job" in thermofleet("job", "submit", "--quote", *at)[2]
    assert r"must be UTF-8 text (got '\udcff')" in thermofleet("job", "submit", "--quote", "--kind", "\udcff", *at)[2]
    heavy = thermofleet("job", "submit", "--quote", "--kind", "hold", "--place", "rack", "--payload", "11", *at)
    assert "--payload must be 0 to 10 (got 11)" in heavy[2]
    told = thermofleet("job", "submit", "--quote", "--kind", "pick_and_place", *at)[2]
    told_kinds = "did you mean 'pick_place'? Allowed: hold, pick_place, press, sort (at kind)."
    assert f"Invalid job: No kind of job 'pick_and_place'; {told_kinds}" in " ".join(told.split())
    code, _, err = thermofleet("job", "submit", "--quote", "--kind", "hold", "--place", "rack", *at)
    assert code == 2
    assert "No arm of fleet 'f' replied" in err
