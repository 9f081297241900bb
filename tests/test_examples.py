"""The examples run as their first lines say, and see what the fleet does."""

import importlib.util
import json
import os
import re
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType

import pytest

from fleet.bus.client.client import BusClient
from fleet.bus.client.router import Router
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
    Clock,
    ClockRequest,
    JobEstimate,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
)
from fleet.bus.protocol.messages import DifficultyScores, State

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-c", "from scenarios.cli.main import main; main()"]


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path / "cache"))


def test_own_policy_finishes_a_shift(capsys) -> None:
    example("own_policy").main(horizon_s=1800, difficulty="oracle")
    told = capsys.readouterr().out
    for name in ("LeastDifficulty", "Careful"):
        assert re.search(rf"{name}: reward -?[\d.]+, jobs \d+, peaks arm_0 [\d.]+ °C", told)


def test_own_policy_is_compared_beside_the_rules() -> None:
    own = f"{ROOT / 'examples' / 'own_policy.py'}:Careful"
    options = ["--policies", f"least_difficulty,{own}", "--baseline", "least_difficulty", "--seeds", "2"]
    command = [*COMMAND, "compare", "quickstart", *options, "--difficulty", "oracle"]
    done = subprocess.run(command, timeout=120, capture_output=True, text=True, check=True)
    assert "Careful" in done.stdout


def test_monitor_hears_every_arm_from_another_process(tmp_path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    env = os.environ | {"PYTHONUNBUFFERED": "1"}
    monitor = subprocess.Popen(
        [sys.executable, str(ROOT / "examples" / "monitor.py"), str(port)], stdout=subprocess.PIPE, text=True, env=env
    )
    try:
        command = [*COMMAND, "run", "quickstart"]
        options = ["--difficulty", "blind", "--listen", str(port), "--out", str(tmp_path / "run"), "--seed", "1"]
        subprocess.run([*command, *options], check=True, timeout=120, env=env, capture_output=True)
        told, _ = monitor.communicate(timeout=60)
    finally:
        monitor.kill()
    assert monitor.returncode == 0
    assert all(f"arm_{i}" in told for i in range(4))
    assert "hottest motor" in told


PATIENCE_S = 20.0
JOB = JobSpec(name="crate 1", kind="hold", places=("rack",), repetitions=3, payload_kg=1.0)


@contextmanager
def running(name, *arguments):
    """An example in a process of its own, from when it says that it is ready."""
    command = [sys.executable, "-u", str(ROOT / "examples" / f"{name}.py"), *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        line = process.stdout.readline()
        assert line.startswith("ready"), line + process.stdout.read()
        yield process
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE_S)


@pytest.fixture
def bus():
    """The port of a router, and what makes lines to it."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        port = int(router.endpoint.rsplit(":", 1)[1])
        yield port, lambda: stack.enter_context(BusClient(router.endpoint, "f"))


def serve(condition, *links):
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        for link in links:
            link.serve(time.monotonic() + 0.02)


def only(answers):
    """The one answer to a question."""
    assert not answers.refused
    (word,) = answers.messages.values()
    return word


def test_own_arm_keeps_the_rules_towards_a_strict_auctioneer(bus):
    port, link = bus
    auctioneer, leave, asked, reports, states = link(), [], [], [], []

    def lease(request):
        asked.append(request)
        held = tuple(hold.award for hold in request.entries)
        return Lease(auctioneer="a", lease_s=6.0, granted=held, revoked=(), may_commit=held if leave else ())

    def report(word):
        reports.append(word)
        return Receipt(auctioneer="a", award=word.award)

    auctioneer.reply_to(keys.asked_by_every_arm("f", "a", "lease"), LeaseRequest, lease)
    auctioneer.reply_to(keys.asked_by_every_arm("f", "a", "report"), Report, report)
    auctioneer.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(time_s=5000.0, speed=60.0))
    auctioneer.subscribe(keys.of_every_arm("f", "state"), State, lambda _, word: states.append(word))
    scores, told = [], []
    auctioneer.subscribe(keys.of_every_arm("f", "difficulty"), DifficultyScores, lambda _, word: scores.append(word))
    auctioneer.watch_tokens(keys.of_every_arm("f", "alive"), lambda arm, there: told.append((arm, there)))
    command = [sys.executable, "-u", str(ROOT / "examples" / "own_arm.py"), str(port), "f", "arm 1+b"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        serve(lambda: ("arm 1+b", True) in told and states, auctioneer)
        assert states[0].time_s >= 5000.0

        def question(key, word, kind):
            return only(auctioneer.query_and_wait(keys.of_arm("f", "arm 1+b", key), word, kind, timeout_s=PATIENCE_S))

        dry = question("quote", QuoteRequest(auction="r", jobs=(JOB,), dry_run=True), Quote)
        assert dry.quote == ""
        quote = question("quote", QuoteRequest(auction="r", jobs=(JOB,)), Quote)
        assert quote.estimates[0].feasible
        serve(lambda: scores, auctioneer)
        assert scores[0].difficulty == (quote.estimates[0].plans[0].difficulty,)
        award = Award(award="r-crate", auction="r", auctioneer="a", quote=quote.quote, job=JOB)
        first, again = (question("award", award, Ack) for _ in range(2))
        assert first == again
        assert first.accepted
        second = Award(award="r-other", auction="r", auctioneer="a", quote=quote.quote, job=JOB)
        assert not question("award", second, Ack).accepted
        unheard = Award(award="r-unheard", auction="r", auctioneer="a", quote="never made", job=JOB)
        assert not question("award", unheard, Ack).accepted

        serve(lambda: any(hold.phase == "finishing" for request in asked for hold in request.entries), auctioneer)
        asked.clear()
        serve(lambda: asked, auctioneer)  # it waits at its last cycle until it may begin it
        assert asked[0].entries[0].cycles == JOB.repetitions - 1
        assert not reports
        leave.append(True)
        serve(lambda: reports, auctioneer)
        assert (reports[0].outcome, reports[0].cycles, reports[0].job) == ("finished", 3, "crate 1")
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE_S)
    serve(lambda: ("arm 1+b", False) in told, auctioneer)
    assert auctioneer.malformed == 0


def test_own_allocator_keeps_the_rules_towards_a_strict_arm(bus):
    port, link = bus
    arm, awards, results = link(), [], []
    leases, receipts = [], []

    def offer(job):
        return JobEstimate(job.name, (PlanQuote(difficulty=0.5),))

    def quote(request):
        return Quote(
            arm="x", auction=request.auction, quote=f"x-{request.auction}", valid_s=3.0, twin="t", time_s=1.0,
            mode="idle", headroom_k=20.0, capacity=0 if awards else 1, estimates=tuple(map(offer, request.jobs)),
        )  # fmt: skip

    def take(award):
        awards.append(award)
        return Ack(arm="x", award=award.award, accepted=True)

    arm.reply_to(keys.of_arm("f", "x", "quote"), QuoteRequest, quote)
    arm.reply_to(keys.of_arm("f", "x", "award"), Award, take)
    arm.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, word: results.append(word.status.state))
    with running("own_allocator", port, "f"):
        command = [sys.executable, str(ROOT / "examples" / "submit_jobs.py"), str(port), "f"]
        outsider = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            serve(lambda: awards, arm)

            def hold(phase, cycles):
                holds = (LeaseEntry(award=awards[0].award, job=awards[0].job.name, cycles=cycles, phase=phase),)
                key = keys.asked_by("f", "own", "lease", "x")
                request = LeaseRequest(arm="x", entries=holds)
                arm.query(key, request, Lease, lambda answers: leases.append(only(answers)), timeout_s=PATIENCE_S)
                serve(lambda: leases, arm)
                return leases.pop()

            assert awards[0].award not in hold("working", 0).may_commit
            assert awards[0].award in hold("finishing", 0).may_commit
            word = Report(
                arm="x", award=awards[0].award, job=awards[0].job.name, outcome="finished", cycles=1, time_s=3.0
            )
            for _ in range(2):
                key = keys.asked_by("f", "own", "report", "x")
                arm.query(key, word, Receipt, lambda answers: receipts.append(only(answers)), timeout_s=PATIENCE_S)
            serve(lambda: len(receipts) == 2 and "finished" in results, arm)
            assert receipts[0] == receipts[1]
            assert awards[0].award in hold("working", 0).revoked
            status = only(
                arm.query_and_wait(keys.of_jobs("f", "status"), StatusRequest(), Status, timeout_s=PATIENCE_S)
            )
            assert {word.job: word.state for word in status.jobs}[awards[0].job.name] == "finished"
        finally:
            outsider.kill()
            outsider.communicate(timeout=PATIENCE_S)
    assert arm.malformed == 0


def test_own_allocator_does_not_begin_beside_arms_that_share_jobs_out(bus):
    """They show no auctioneer's token: one of them answers for all."""
    port, link = bus
    arm = link()
    arm.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: Status(auctioneer="x", time_s=1.0, jobs=()))
    command = [sys.executable, str(ROOT / "examples" / "own_allocator.py"), str(port), "f"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            serve(lambda: process.poll() is not None, arm)
        finally:
            process.kill()
        assert process.returncode == 1
        assert "jobs/status already" in process.stderr.read()
    assert arm.malformed == 0


@pytest.mark.parametrize("kinds", [("own_arm", "quote"), ("own_arm", "award"), ("own_allocator", "lease")])
@pytest.mark.parametrize(
    ("payload", "said"),
    [(b"{", None), (b"[]", None), (b"{}", None), (b"\xff", None), (b"{}", "text/plain"), (b'{"jobs": 3}', None)],
)
def test_an_example_survives_rubbish_and_says_what_is_wrong(rubbish_at, kinds, payload, said):
    assert "Malformed" in rubbish_at(*kinds, payload, said)


@pytest.fixture(scope="module")
def rubbish_at():
    """Asks an example at a key for an answer to rubbish; each runs once for all questions."""
    words = {"quote": "QuoteRequest", "award": "Award", "lease": "LeaseRequest"}
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        port = int(router.endpoint.rsplit(":", 1)[1])
        line = stack.enter_context(BusClient(router.endpoint, "f"))
        stack.enter_context(running("own_arm", port, "f", "x"))
        stack.enter_context(running("own_allocator", port, "f"))

        def ask(example, topic, payload, said):
            key = keys.of_arm("f", "x", topic) if example == "own_arm" else keys.asked_by("f", "own", topic, "x")
            encoding = said or f"application/json;thermofleet.{words[topic]}.v4"
            (reply,) = list(line._session.get(key, payload=payload, encoding=encoding, timeout=PATIENCE_S))
            assert str(reply.ok.encoding) == "application/json;thermofleet.Refusal.v4"
            return json.loads(reply.ok.payload.to_string())["reason"]

        yield ask


def test_the_examples_make_a_fleet_of_their_own(bus):
    port, link = bus
    watcher, heard = link(), []
    watcher.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, word: heard.append(word.status))
    watcher.subscribe(keys.of_every_arm("f", "state"), State, lambda _, word: None)
    monitor = subprocess.Popen(
        [sys.executable, "-u", str(ROOT / "examples" / "monitor.py"), str(port)], stdout=subprocess.PIPE, text=True
    )
    assert monitor.stdout.readline().startswith("waiting")
    with running("own_arm", port, "f", "a"), running("own_arm", port, "f", "b"), running("own_allocator", port, "f"):
        command = [sys.executable, str(ROOT / "examples" / "submit_jobs.py"), str(port), "f"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "3 of 3 jobs finished" in done.stdout
        serve(lambda: sum(status.state == "finished" for status in heard) >= 3, watcher)
    try:
        told, _ = monitor.communicate(timeout=PATIENCE_S)
    finally:
        monitor.kill()
    assert re.search(r"own +outside 1 is finished [ab]\n", told)
    assert re.search(r" [ab] +difficulty outside 1 0\.10", told)
    finished = [status.job for status in heard if status.state == "finished"]
    assert sorted(finished) == ["outside 1", "outside 2", "outside 3"]
    assert finished.index("outside 1") < finished.index("outside 3")
    assert watcher.malformed == 0


def test_own_arm_and_the_submitter_work_with_the_real_auctioneer(bus, tmp_path):
    """The auctioneer of `thermofleet auction`, an arm and a submitter that know it from docs/bus.md alone."""
    port, link = bus
    watcher, heard = link(), []
    watcher.subscribe(
        keys.of_every_auction("f", "result"), Result, lambda _, word: heard.append(word.status), history=True
    )
    options = [
        "--jobs",
        "none",
        "--fleet",
        "f",
        "--endpoint",
        f"tcp/127.0.0.1:{port}",
        "--journal",
        str(tmp_path / "j"),
    ]
    auction = subprocess.Popen(
        [*COMMAND, "auction", "quickstart", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert auction.stdout.readline().startswith("ready")
        for arm in range(4):  # those of the scenario are not there; until then each may be anywhere
            clear = [*COMMAND, "clear", f"arm_{arm}", "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}"]
            cleared = subprocess.run(clear, capture_output=True, text=True, timeout=60, check=True)
            assert cleared.stdout == f"arm_{arm}: its space is free until the arm reports its space again.\n"
        with running("own_arm", port, "f", "a"), running("own_arm", port, "f", "b"):
            command = [sys.executable, str(ROOT / "examples" / "submit_jobs.py"), str(port), "f"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
        auction.terminate()
        told = auction.communicate(timeout=PATIENCE_S)[1]
        assert auction.returncode == 0
        assert "Left out" not in told  # nothing that the examples said was malformed
        serve(lambda: sum(status.state == "finished" for status in heard) == 3, watcher)
        assert sorted(status.job for status in heard if status.state == "finished") == [
            "outside 1",
            "outside 2",
            "outside 3",
        ]
    finally:
        auction.kill()
        auction.communicate(timeout=PATIENCE_S)


@pytest.mark.slow
def test_own_allocator_has_real_arms_do_the_jobs(bus, tmp_path):
    """`thermofleet arm`, which plans and simulates, under an allocator that knows it from docs/bus.md alone."""
    port, link = bus
    watcher, heard = link(), []
    watcher.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, word: heard.append(word.status))
    watcher.subscribe(keys.of_every_arm("f", "state"), State, lambda _, word: None)
    with running("own_allocator", port, "f") as allocator, ExitStack() as stack:
        for name in ("arm_0", "arm_1"):
            options = ["--difficulty", "blind", "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}"]
            command = [*COMMAND, "arm", "quickstart", name, *options, "--journal", str(tmp_path / name)]
            arm = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
            stack.callback(arm.communicate)
            stack.callback(arm.kill)
            assert arm.stdout.readline().startswith("ready")
        command = [sys.executable, "-u", str(ROOT / "examples" / "submit_jobs.py"), str(port), "f"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)
        assert "3 of 3 jobs finished" in done.stdout, done.stdout + done.stderr
        assert allocator.poll() is None
    serve(lambda: sum(status.state == "finished" for status in heard) == 3, watcher)
    assert watcher.malformed == 0


def test_every_example_for_outsiders_imports_nothing_of_ours():
    for name in ("monitor", "submit_jobs", "own_arm", "own_allocator"):
        source = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
        imported = set(re.findall(r"^(?:import|from) (\w+)", source, re.MULTILINE))
        assert imported - set(sys.stdlib_module_names) == {"zenoh"}
