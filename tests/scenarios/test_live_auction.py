"""`thermofleet bus auctioneer` and its parts."""

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from fleet.bus.protocol.auction import (
    Admission,
    JobSpec,
    Submission,
    SubmissionReply,
)
from fleet.job import Job, Place, Work
from scenarios.live import auctioneer as live_auction
from scenarios.live.auctioneer import job_spec, own_jobs
from scenarios.live.journals import refuse_other_way
from scenarios.prepare.fleet import make_env
from scenarios.spec.load import load
from tests import commands
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
HOLD = {"name": "a", "kind": "hold", "places": ["rack"], "repetitions": 2}


def test_the_stream_is_the_one_of_a_run(small_toml, plans):
    """Against the world that a run lays out for the same seed."""
    scenario = load(small_toml)
    env = make_env(scenario, difficulty="blind", cache=plans)
    for seed in (0, 3):
        env.reset(seed=seed)
        table, drawn = env.world.jobs, own_jobs(scenario, seed)
        assert {word.name for _, word in drawn} == set(table.names[0])
        for name, release_s, repetitions in zip(table.names[0], table.release_s[0], table.repetitions[0], strict=True):
            (word,) = (word for _, word in drawn if word.name == name)
            assert (word.release_s, word.repetitions) == (release_s, repetitions)


def test_a_job_is_submitted_after_those_it_waits_for(small_toml):
    drawn = own_jobs(load(small_toml), 0)
    assert [at_s for at_s, _ in drawn] == sorted(at_s for at_s, _ in drawn)
    seen: set[str] = set()
    for at_s, word in drawn:
        assert at_s >= word.release_s
        assert set(word.after) <= seen
        seen.add(word.name)


class Stage:
    """Stands in for a node: an hour passes with every turn, and a job is done in the turn after it was handed in."""

    def __init__(self) -> None:
        self.time_s, self.handed_in, self.open, self.ended = 0.0, [], [], False
        self.alone_s = 0.0
        ledger = SimpleNamespace(unsettled=lambda: self.open, ended=False)
        self.auctioneer = SimpleNamespace(ledger=ledger, finishing=lambda: False)

    @property
    def rivals(self) -> set[str]:
        return {"other"} if self.time_s < self.alone_s else set()

    def serve(self, _until_s: float) -> None:
        self.time_s += 3600.0
        self.open = []

    def submit(self, word: Submission) -> SubmissionReply:
        self.handed_in.append((self.time_s, [job.name for job in word.jobs]))
        self.open = list(word.jobs)
        return SubmissionReply("auctioneer", tuple(Admission(job.name, True) for job in word.jobs))

    def end(self) -> None:
        self.ended = True


@pytest.mark.parametrize(("horizon_s", "ended"), [(1e6, False), (7200.0, True)])
def test_a_stream_is_submitted_as_released_until_all_is_done_or_the_shift_is_over(monkeypatch, horizon_s, ended):
    monkeypatch.setattr(live_auction, "FAREWELL_S", (0.0, 0.0))
    stage, never = Stage(), SimpleNamespace(is_set=lambda: False)
    names = {"a": 0.0, "b": 3700.0, "c": 7000.0, "d": 10000.0}
    stream = [(at_s, JobSpec(name, "hold", ("x",))) for name, at_s in names.items()]
    live_auction.submit_stream(stage, stream, horizon_s, never)
    all_of_it = [(3600.0, ["a"]), (7200.0, ["b", "c"]), (10800.0, ["d"])]
    assert stage.handed_in == (all_of_it[:2] if ended else all_of_it)
    assert stage.ended is ended


def test_a_finished_shift_submits_no_job_again(monkeypatch):
    monkeypatch.setattr(live_auction, "FAREWELL_S", (0.0, 0.0))
    stage, never = Stage(), SimpleNamespace(is_set=lambda: False)
    stage.auctioneer.ledger.ended = True
    live_auction.submit_stream(stage, [(0.0, JobSpec("a", "hold", ("x",)))], 1.0, never)
    assert stage.handed_in == []


def test_no_job_is_submitted_while_another_auctioneer_is_present(monkeypatch):
    monkeypatch.setattr(live_auction, "FAREWELL_S", (0.0, 0.0))
    stage, never = Stage(), SimpleNamespace(is_set=lambda: False)
    stage.alone_s = 7200.0
    live_auction.submit_stream(stage, [(0.0, JobSpec("a", "hold", ("x",)))], 1e6, never)
    assert stage.handed_in == [(7200.0, ["a"])]


def test_a_job_message_has_all_fields():
    place = Place(name="rack", position_m=(0.0, 0.0, 0.0))
    work = Work(kind="press", places=(place,), force_n=30.0, dwell_s=20.0)
    job = Job(name="p", work=work, repetitions=6, release_s=1.0, due_s=9.0, value=3.0, after=("q",))
    assert job_spec(job) == JobSpec("p", "press", ("rack",), 6, 0.0, 20.0, 30.0, 1.0, 9.0, 3.0, ("q",))


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("bus", "auctioneer", "quickstart", "--policy", "match"), "No policy 'match'; did you mean 'matching'?"),
        (("up", "quickstart", "--policy", "sssi"), "did you mean 'ssi'?"),
        (
            ("bus", "auctioneer", "quickstart", "--policy", "consensus"),
            "'consensus' of scope arm runs without an auctioneer. Start",
        ),
        (
            ("bus", "auctioneer", "quickstart", "--policy", "random"),
            "'random' of scope arm runs without an auctioneer. Start",
        ),
        (
            ("arm", "run", "quickstart", "arm_0", "--policy", "wspt"),
            "'wspt' needs an auctioneer: start it with thermofleet bus auctioneer",
        ),
        (("arm", "run", "quickstart", "arm_9", "--policy", "random"), "No arm 'arm_9' in quickstart"),
        (
            ("arm", "run", "quickstart", "arm_0", "--policy", "ssi"),
            "'ssi' needs an auctioneer: start it with thermofleet bus auctioneer",
        ),
        (("arm", "run", "quickstart", "arm_0", "--jobs", "all"), "No source of jobs 'all'. Allowed: none, scenario."),
    ],
)
def test_an_invalid_policy_is_one_sentence(thermofleet, words, complaint):
    code, _, err = thermofleet(*words)
    assert code == 2
    assert complaint in " ".join(err.split())


@pytest.mark.parametrize(
    ("words", "files", "complaint"),
    [
        (
            ("up", "quickstart", "--policy", "consensus", "--out"),
            ["arm_2.journal"],
            "the shift had an auctioneer",
        ),
        (("up", "quickstart", "--out"), ["arm_2.journal", "arm_2.grants"], "belongs to a shift without an auctioneer"),
        (
            ("bus", "auctioneer", "quickstart", "--journal"),
            ["arm_2.grants"],
            "belongs to a shift without an auctioneer",
        ),
        (
            ("arm", "run", "quickstart", "arm_2", "--journal"),
            ["arm_2.grants"],
            "belongs to a shift without an auctioneer",
        ),
        (
            ("arm", "run", "quickstart", "arm_2", "--policy", "consensus", "--journal"),
            ["arm_2.journal"],
            "has no 'arm_2.grants'",
        ),
    ],
)
def test_a_shift_is_not_continued_with_the_other_kind_of_allocation(thermofleet, tmp_path, words, files, complaint):
    """Who goes on from the journals of the other way does not know what is done, and would have it done again."""
    folder = tmp_path / "journals" if words[0] == "up" else tmp_path
    folder.mkdir(exist_ok=True)
    for file in files:
        (folder / file).write_text("{}\n")
    code, _, err = thermofleet(*words, tmp_path)
    assert code == 2
    assert complaint in " ".join(err.split())


def test_a_shift_is_continued_with_its_own_kind_of_allocation(tmp_path):
    for alone in (True, False):
        refuse_other_way(tmp_path / "none", ("a",), alone=alone)
    for file in ("alone.journal", "alone.grants", "led.journal"):
        (tmp_path / file).write_text("{}\n")
    for file in ("new.journal", "new.grants"):
        (tmp_path / file).touch()
    refuse_other_way(tmp_path, ("alone", "new"), alone=True)
    refuse_other_way(tmp_path, ("led", "new"), alone=False)


@contextmanager
def auctioneer(endpoint: str, folder: Path, *words: object) -> Iterator[subprocess.Popen[str]]:
    """The command as a process that has said that it is ready."""
    with commands.start("bus", "auctioneer", "--endpoint", endpoint, "--journal", folder, *words) as process:
        assert process.stdout is not None
        try:
            said = process.stdout.readline()
            assert said == f"ready auctioneer {endpoint} {process.pid}\n"
            yield process
        finally:
            process.kill()


def test_submitted_jobs_survive_a_kill(endpoint, tmp_path, thermofleet):
    file = tmp_path / "jobs.jsonl"
    file.write_text("\n".join(json.dumps(HOLD | {"name": n, "places": [p]}) for n, p in (("a", "belt"), ("b", "moon"))))
    at = ("--endpoint", endpoint, "--fleet", "quickstart")
    with auctioneer(endpoint, tmp_path, "quickstart", "--jobs", "none") as process:
        code, out, _ = thermofleet("job", "submit", file, *at)
        assert code == 1
        assert out.startswith("a: accepted\nb: refused: No place 'moon' in this cell. Places: ")
        code, _, err = thermofleet(
            "bus", "auctioneer", "quickstart", "--endpoint", endpoint, "--journal", tmp_path / "other"
        )
        assert code == 2
        assert "Fleet 'quickstart' has an auctioneer 'auctioneer' already: its token is present." in err
        other = ("--name", "other", "--journal", tmp_path / "other")
        code, _, err = thermofleet("bus", "auctioneer", "quickstart", "--endpoint", endpoint, *other)
        assert code == 2
        assert "Fleet 'quickstart' has an auctioneer already: 'auctioneer'." in err
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE_S)
    with auctioneer(endpoint, tmp_path, "quickstart", "--jobs", "none") as process:
        file.write_text(json.dumps(HOLD | {"places": ["belt"]}))
        assert thermofleet("job", "submit", file, *at)[:2] == (0, "a: accepted\n")
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert "0 of 1 jobs finished" in out
        assert "Continuing from" in err


def test_the_end_of_a_shift_lists_unfinished_jobs(endpoint, tmp_path):
    short = tmp_path / "short.toml"
    text = (ROOT / "scenarios" / "library" / "quickstart.toml").read_text(encoding="utf-8")
    short.write_text(text.replace("horizon_s = 7200", "horizon_s = 600"), encoding="utf-8")
    with auctioneer(endpoint, tmp_path / "journal", short, "--speed", "1000") as process:
        out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "unfinished, The shift ended before it was done." in out
