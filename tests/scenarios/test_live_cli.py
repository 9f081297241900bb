"""`thermofleet arm run`, `bus auctioneer`, `job submit` and `job list`."""

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fleet.arm.model import ArmModel
from fleet.arm.plan_cache import rest_torque
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
from fleet.bus.protocol.messages import Info, State
from fleet.bus.protocol.operator import Controlled, ControlRequest
from fleet.bus.router import Router
from fleet.errors import BusError, FleetError, LogError
from fleet.job import Job, Place, Work
from fleet.live.job_client import batches
from fleet.readings import gravity_terms
from scenarios import terminal
from scenarios.live import auctioneer as live_auction
from scenarios.live.arm import ambient_of, replayed_arm, wait_for_name
from scenarios.live.auctioneer import job_spec, refuse_other_way, scenario_jobs
from scenarios.live.fleet_processes import CARD
from scenarios.live.requests import read_jobs
from scenarios.prepare.fleet import make_env, prepare, prepare_arm
from scenarios.spec.load import load
from scenarios.spec.schema import Ambient
from tests import commands
from tests.live.many_jobs import ManyJobs, entries
from tests.waiting import PATIENCE_S, serve_until, serving
from twin.logs.recording import READINGS

TIME_S = np.arange(0.0, 4.0, 0.1)


@pytest.fixture
def log(tmp_path):
    """A plain log in which the channels of joint k but velocity and torque rise by k a second from their own starts."""
    starts = dict(zip(READINGS, (0.0, 0.0, 30.0, 3.0, 30.0), strict=True))
    rise = TIME_S[:, None] * np.arange(1, 8) / 100
    channels = {channel: start + rise for channel, start in starts.items()}
    channels["qd"] = np.full_like(rise, np.arange(1, 8) / 100)
    channels["tau"] = gravity_terms(channels["q"])[:, :, 2]
    columns = np.hstack([TIME_S[:, None] + 50.0, *channels.values()])
    header = ",".join(["time_s", *(f"{channel}_{k}" for channel in READINGS for k in range(1, 8))])
    path = tmp_path / "real.csv"
    np.savetxt(path, columns, delimiter=",", header=header, comments="", fmt="%.12g")
    return path


def receive(link, fleet, is_enough):
    """States and the info of an arm, once there are enough."""
    states, infos = [], []
    link.subscribe(keys.of_every_arm(fleet, "state"), State, lambda _, message: states.append(message))
    link.subscribe(keys.of_every_arm(fleet, "info"), Info, lambda _, message: infos.append(message), history=True)
    serve_until(lambda: infos and is_enough(states), link)
    return states, infos[-1]


ARM = {
    "ghost": "No arm 'ghost'",
    "left --source log": "log with a FILE",
    "left some.csv": "log with a FILE",
    "left --twin some": "--twin and --network are for --source log",
    "left --source video": "No source 'video'. Allowed: log, sim.",
    "left --difficulty oracle": "No difficulty 'oracle'. Allowed: blind, twin.",
    "left --rate-hz 1000": "--rate-hz must be > 0 and at most 100 (got 1000).",
    "left none.csv --source log": "none.csv",
    "left --difficulty blind --endpoint udp/127.0.0.1:1": "is no endpoint of this bus",
    "left --policy wspt": "'wspt' needs an auctioneer: start it with thermofleet bus auctioneer",
    "left --policy random --jobs all": "No source of jobs 'all'. Allowed: none, scenario.",
}
POLICIES = {
    "up quickstart --webhook http://127.0.0.1:9/": "add --page",
    "up quickstart --page --webhook http://127.0.0.1:9/": "set THERMOFLEET_WEBHOOK_SECRET to 16 or more characters",
    "bus auctioneer quickstart --policy match": "No policy 'match'; did you mean 'matching'?",
    "bus auctioneer quickstart --policy consensus": "'consensus' of scope arm runs without an auctioneer. Start",
}
WRONG = {f"arm run heat.toml {words}": complaint for words, complaint in ARM.items()} | POLICIES


@pytest.mark.parametrize("words", WRONG)
def test_an_error_of_a_command_is_one_sentence(thermofleet, small_toml, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    assert thermofleet(*words.split()).refused(WRONG[words])


def test_a_single_arm_equals_the_arm_of_the_fleet(small_toml, plans):
    scenario = load(small_toml)
    fleet = prepare(scenario, difficulty="blind", cache=plans)
    alone, same = prepare_arm(scenario, "right", difficulty="blind", cache=plans), fleet.arms[1]
    assert alone.robot == same.robot
    for name in ("motors", "thermal"):
        for one, other in zip(vars(getattr(alone, name)).values(), vars(getattr(same, name)).values(), strict=True):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(alone.rest_tau, same.rest_tau)
    assert alone.plans.keys() == same.plans.keys()
    for work, variants in alone.plans.items():
        for one, other in zip(variants, same.plans[work], strict=True):
            np.testing.assert_array_equal(one.cycle.profile, other.cycle.profile)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_an_arm_runs_as_a_process_and_exits_on_a_signal(small_toml, tmp_path, number, code):
    with Router() as router, BusClient(router.endpoint, "heat") as link:
        options = ["--endpoint", router.endpoint, "--difficulty", "blind", "--rate-hz", 20]
        with commands.ready("arm", "run", small_toml, "left", *options, cwd=tmp_path) as (arm, line):
            assert line.split() == ["ready", "left", router.endpoint, str(arm.pid)]
            states, info = receive(link, "heat", lambda states: len(states) > 5)
            assert "torch" not in Path(f"/proc/{arm.pid}/maps").read_text()
            returned, said = commands.end(arm, number)
    assert returned == code, said
    assert (info.twin, states[-1].mode) == ("blind", "idle")
    assert (tmp_path / "runs/live-heat/left.journal").is_file()
    if number == signal.SIGINT:
        assert "the same command continues" in said.replace("\n", " ")


def test_a_log_is_replayed_as_an_arm(small_toml, log, tmp_path):
    with Router() as router, BusClient(router.endpoint, "heat") as link:
        options = ["--source", "log", "--endpoint", router.endpoint, "--speed", 4, "--rate-hz", 20]
        with commands.ready("arm", "run", small_toml, "museum", log, *options, cwd=tmp_path) as (arm, line):
            assert line.startswith("ready museum")
            states, info = receive(link, "heat", lambda states: states and states[-1].mode == "idle")
            job = JobSpec(name="j", kind="hold", places=("bench",))
            answers = link.query_and_wait(
                keys.of_every_arm("heat", "quote"), QuoteRequest("q", (job,), dry_run=True), Quote, timeout_s=PATIENCE_S
            )
            assert commands.end(arm, signal.SIGTERM)[0] == 0
    assert info.twin == "log real.csv"
    (quote,) = answers.messages.values()
    assert "replays the log 'real.csv'" in quote.estimates[0].reason
    last, rise = states[-1], TIME_S[-1] * np.arange(1, 8) / 100
    np.testing.assert_allclose(last.temp_c, 30.0 + rise, atol=1e-9)
    np.testing.assert_allclose(last.q, rise, atol=1e-9)
    np.testing.assert_allclose(last.tau, gravity_terms(np.array([last.q]))[0, :, 2], atol=0.02)
    np.testing.assert_allclose(last.current_a, 3.0 + rise, atol=1e-9)


def test_no_second_arm_of_a_name_starts_before_the_token_of_the_first_expires(token_reaches):
    with Router(0) as router, BusClient(router.endpoint, "f") as second:
        with BusClient(router.endpoint, "f") as first:
            first.declare_token(keys.of_arm("f", "a", "alive"))
            token_reaches(second, keys.of_arm("f", "a", "alive"))
            wait_for_name(second, "b", patience_s=PATIENCE_S)
            with pytest.raises(BusError, match="Arm 'a' of fleet 'f' is already running"):
                wait_for_name(second, "a", patience_s=0.3)
            leaves = threading.Timer(0.3, first.close)
            leaves.start()
            wait_for_name(second, "a", patience_s=PATIENCE_S)
            leaves.join()
        assert not second.tokens(keys.of_arm("f", "a", "alive"))


def test_a_log_without_temperatures_is_refused(log, tmp_path):
    bare = tmp_path / "bare.csv"
    lines = log.read_text().splitlines()
    bare.write_text("\n".join(",".join(line.split(",")[:22]) for line in lines))
    with pytest.raises(LogError, match="no motor temperatures"):
        replayed_arm("arm", bare)


@pytest.mark.parametrize("points", [((0.0, 28.0),), ((0.0, 28.0), (600.0, 28.0)), ((0.0, 20.0), (600.0, 40.0))])
def test_the_ambient_temperature_is_that_of_the_scenario(points):
    scenario = replace(load("quickstart"), ambient=Ambient(points=points))
    for time_s in (-1.0, 0.0, 150.0, 600.0, 1e6):
        assert ambient_of(scenario)(time_s) == np.interp(time_s, *zip(*points, strict=True))


@pytest.mark.ci_slow
def test_a_blind_arm_whose_plans_are_known_loads_no_physics(tmp_path):
    """64 of them on one machine would each take 50 MB more."""
    prepare(load("quickstart"), difficulty="blind", cache=tmp_path)
    program = f"""
import sys
from pathlib import Path
from scenarios.progress import quiet
from scenarios.live.arm import simulated_arm
from scenarios.spec.load import load
made = simulated_arm(load("quickstart"), "arm_0", "blind", 0, quiet, Path({str(tmp_path)!r}))
made.body(0.0, 0.1).advance(1.0)
print(*sys.modules)
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    heavy = {"mujoco", "mink", "ruckig", "scipy", "torch", "pettingzoo", "gymnasium", "numba", "pyarrow", "plotly"}
    assert set(said.stdout.split()) & heavy == set()


def test_the_torque_at_home_is_the_same_from_the_cache(tmp_path):
    fresh, kept = (prepare_arm(load("quickstart"), "arm_2", difficulty="blind", cache=tmp_path) for _ in range(2))
    assert fresh.rest_tau.tolist() == kept.rest_tau.tolist()
    assert fresh.rest_tau.tolist() == ArmModel(fresh.robot).gravity_torque(fresh.robot.home_q()).tolist()
    tilted = replace(fresh.robot, mount=replace(fresh.robot.mount, tilt_deg=(30.0, 0.0, 0.0)))
    heavier = replace(fresh.robot, tool_kg=fresh.robot.tool_kg + 1.0)
    for other in (tilted, heavier):
        assert rest_torque(other, tmp_path / "plans").tolist() != fresh.rest_tau.tolist()


HOLD = {"name": "a", "kind": "hold", "places": ["rack"], "repetitions": 2}


def test_the_stream_is_the_one_of_a_run(small_toml, plans):
    """Against the world that a run lays out for the same seed."""
    scenario = load(small_toml)
    env = make_env(scenario, difficulty="blind", cache=plans)
    for seed in (0, 3):
        env.reset(seed=seed)
        shift, drawn = env.world.shifts[0], scenario_jobs(scenario, seed)
        assert {word.name for _, word in drawn} == set(shift.names)
        for name, release_s, repetitions in zip(shift.names, shift.release_s, shift.repetitions, strict=True):
            (word,) = (word for _, word in drawn if word.name == name)
            assert (word.release_s, word.repetitions) == (release_s, repetitions)


def test_a_job_is_submitted_after_those_it_waits_for(small_toml):
    drawn = scenario_jobs(load(small_toml), 0)
    assert [at_s for at_s, _ in drawn] == sorted(at_s for at_s, _ in drawn)
    seen: set[str] = set()
    for at_s, word in drawn:
        assert at_s >= word.release_s
        assert set(word.after) <= seen
        seen.add(word.name)


class Stage:
    """Stands in for a node: an hour passes with every turn, and a job is done in the turn after its submission."""

    def __init__(self, *, over: bool = False, alone_s: float = 0.0) -> None:
        self.time_s, self.alone_s, self.submitted, self.open = 0.0, alone_s, [], []
        self.book = SimpleNamespace(unsettled=lambda: self.open, ended=over)
        self.auctioneer = SimpleNamespace(finishing=lambda: False)

    @property
    def rivals(self) -> set[str]:
        return {"other"} if self.time_s < self.alone_s else set()

    def serve(self, _until_s: float) -> None:
        self.time_s += 3600.0
        self.open = []

    def submit(self, submission: Submission) -> SubmissionReply:
        self.submitted.append((self.time_s, [job.name for job in submission.jobs]))
        self.open = list(submission.jobs)
        return SubmissionReply("auctioneer", tuple(Admission(job.name, True) for job in submission.jobs))

    def end(self) -> None:
        self.book.ended = True


NAMES = {"a": 0.0, "b": 3700.0, "c": 7000.0, "d": 10000.0}
ALL = [(3600.0, ["a"]), (7200.0, ["b", "c"]), (10800.0, ["d"])]


@pytest.mark.parametrize(
    ("stage", "horizon_s", "submitted", "ended"),
    [
        (Stage(), 1e6, ALL, False),
        (Stage(), 7200.0, ALL[:2], True),
        (Stage(over=True), 1.0, [], True),
        (Stage(alone_s=7200.0), 1e6, [(7200.0, ["a", "b", "c"]), ALL[2]], False),
    ],
    ids=["all jobs", "the shift ends", "the shift was over", "another auctioneer is present"],
)
def test_a_stream_is_submitted_as_released(monkeypatch, stage, horizon_s, submitted, ended):
    monkeypatch.setattr(live_auction, "FAREWELL_S", (0.0, 0.0))
    stream = [(at_s, JobSpec(name, "hold", ("x",))) for name, at_s in NAMES.items()]
    live_auction.submit_stream(stage, stream, horizon_s, SimpleNamespace(is_set=lambda: False))
    assert (stage.submitted, stage.book.ended) == (submitted, ended)


def test_jobs_of_a_stream_wait_for_room_among_the_open_jobs(monkeypatch):
    monkeypatch.setattr(live_auction, "FAREWELL_S", (0.0, 0.0))
    monkeypatch.setattr(live_auction, "MAX_OPEN_JOBS", 2)
    stage = Stage()
    stream = [(0.0, JobSpec(name, "hold", ("x",))) for name in "abcde"]
    live_auction.submit_stream(stage, stream, 1e6, SimpleNamespace(is_set=lambda: False))
    assert stage.submitted == [(3600.0, ["a", "b"]), (7200.0, ["c", "d"]), (10800.0, ["e"])]


def test_a_job_message_has_all_fields():
    place = Place(name="rack", position_m=(0.0, 0.0, 0.0))
    work = Work(kind="press", places=(place,), force_n=30.0, dwell_s=20.0)
    job = Job(name="p", work=work, repetitions=6, release_s=1.0, due_s=9.0, value=3.0, after=("q",))
    assert job_spec(job) == JobSpec("p", "press", ("rack",), 6, 0.0, 20.0, 30.0, 1.0, 9.0, 3.0, ("q",))


OTHER_KIND = {
    "up quickstart --policy consensus --out": (["arm_2.journal"], "the shift had an auctioneer"),
    "up quickstart --out": (["arm_2.journal", "arm_2.grants"], "belongs to a shift without an auctioneer"),
    "bus auctioneer quickstart --journal": (["arm_2.grants"], "belongs to a shift without an auctioneer"),
    "arm run quickstart arm_2 --journal": (["arm_2.grants"], "belongs to a shift without an auctioneer"),
    "arm run quickstart arm_2 --policy consensus --journal": (["arm_2.journal"], "has no 'arm_2.grants'"),
}


@pytest.mark.parametrize("words", OTHER_KIND)
def test_a_shift_is_not_continued_with_the_other_kind_of_allocation(thermofleet, tmp_path, words):
    """The journals of the other kind do not say what is done: jobs would be done twice."""
    files, complaint = OTHER_KIND[words]
    folder = tmp_path / "journals" if words.startswith("up") else tmp_path
    folder.mkdir(exist_ok=True)
    for file in files:
        (folder / file).write_text("{}\n")
    assert thermofleet(*words.split(), tmp_path).refused(complaint)


@pytest.mark.parametrize(
    ("fleet", "options", "says"),
    [
        ("night", (), "is of fleet 'night', not of 'quickstart': give another --out"),
        ("quickstart", (), "is of a fleet with --seed 3 (got 0): give --seed 3 to continue it, or another --out"),
        ("quickstart", ("--seed", "3"), "of 127.0.0.1 cannot be used (Address already in use). Give another --port"),
        ("quickstart", ("--new-epoch",), "of 127.0.0.1 cannot be used"),
    ],
)
def test_up_refuses_the_folder_of_another_fleet_or_seed(thermofleet, tmp_path, fleet, options, says):
    (tmp_path / CARD).write_text(json.dumps({"fleet": fleet, "seed": 3}))
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        port = held.getsockname()[1]
        assert thermofleet("up", "quickstart", "--out", tmp_path, "--port", port, *options).refused(says)
    assert [each.name for each in tmp_path.iterdir()] == [CARD]


def test_up_forks_its_parts_after_what_it_checks_and_imports(tmp_path):
    """A fork shares no thread: nothing before may start one, as Arrow does."""
    program = f"""
import os
from importlib import import_module
from pathlib import Path
import scenarios.cli.main
from fleet.live.supervisor import _may_fork
from scenarios.live import fleet_processes as up
os.environ["THERMOFLEET_WEBHOOK_SECRET"] = 16 * "x"
up._check_page(None, ["http://127.0.0.1:9/"])
up.refuse_other_fleet(Path({str(tmp_path)!r}), up.FleetCard("quickstart", 0))
for module in (*up.SHARED, *up.SHARED_BY_PAGE):
    import_module(module)
print(_may_fork())
"""
    (tmp_path / CARD).write_text('{"fleet": "quickstart", "seed": 0}')
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout == "True\n", done.stderr


def test_a_shift_is_continued_with_its_own_kind_of_allocation(tmp_path):
    for alone in (True, False):
        refuse_other_way(tmp_path / "none", ("a",), alone=alone)
    for file in ("alone.journal", "alone.grants", "led.journal"):
        (tmp_path / file).write_text("{}\n")
    for file in ("new.journal", "new.grants"):
        (tmp_path / file).touch()
    refuse_other_way(tmp_path, ("alone", "new"), alone=True)
    refuse_other_way(tmp_path, ("led", "new"), alone=False)


def test_submitted_jobs_survive_a_kill(endpoint, tmp_path, thermofleet):
    file = tmp_path / "jobs.jsonl"
    file.write_text("\n".join(json.dumps(HOLD | {"name": n, "places": [p]}) for n, p in (("a", "belt"), ("b", "moon"))))
    at = ("--endpoint", endpoint, "--fleet", "quickstart")
    auctioneer = ("bus", "auctioneer", "quickstart", "--endpoint", endpoint, "--journal", tmp_path, "--jobs", "none")
    with commands.ready(*auctioneer) as (process, line):
        assert line == f"ready auctioneer {endpoint} {process.pid}"
        code, out, _ = thermofleet("job", "submit", file, *at)
        assert code == 1
        assert out.startswith("a: accepted\nb: refused: No place 'moon' in this cell. Places: ")
        table = tmp_path / "jobs.csv"
        table.write_text("name,kind,places\nc,hold,moon\n")
        code, out, err = thermofleet("job", "submit", table, *at)
        assert (code, out) == (2, "")
        assert f"{table} has 1 error:\n  row 2, column places: no place 'moon'. Allowed: " in err
        table.write_text("name,kind,places,after\na,hold,belt,\nd,hold,belt,\ne,hold,belt,no/one\n")
        code, out, _ = thermofleet("job", "submit", table, *at)
        assert (code, out.splitlines()) == (1, [
            f"a: refused: {table}, row 2, column name: Another job has the name 'a'; names must be unique.",
            "d: accepted",
            f"e: refused: {table}, row 4, column after: It waits for 'no/one', which is unknown or was not accepted.",
        ])  # fmt: skip
        thermofleet("job", "cancel", "d", *at)
        second = ("bus", "auctioneer", "quickstart", "--endpoint", endpoint, "--journal", tmp_path / "other")
        says = "Fleet 'quickstart' has an auctioneer 'auctioneer' already: its token is present."
        assert thermofleet(*second).refused(says)
        says = "Fleet 'quickstart' has an auctioneer already: 'auctioneer'."
        assert thermofleet(*second, "--name", "other").refused(says)
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE_S)
    with commands.ready(*auctioneer) as (process, line):
        file.write_text(json.dumps(HOLD | {"places": ["belt"]}))
        assert thermofleet("job", "submit", file, *at)[:2] == (0, "a: accepted\n")
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert "0 of 2 jobs finished" in out
        assert "Continuing from" in err


def test_a_table_with_the_name_of_a_later_job_of_the_scenario_is_refused_in_its_row(endpoint, tmp_path, thermofleet):
    name = scenario_jobs(load("quickstart"), 0)[-1][1].name
    table = tmp_path / "jobs.csv"
    table.write_text(f"name,kind,places\na,hold,belt\n{name},hold,belt\n")
    with commands.ready("bus", "auctioneer", "quickstart", "--endpoint", endpoint, "--journal", tmp_path):
        code, out, _ = thermofleet("job", "submit", table, "--endpoint", endpoint, "--fleet", "quickstart")
    refusal = f"The scenario has another job '{name}', released later; give this one another name."
    assert (code, out.splitlines()) == (1, ["a: accepted", f"{name}: refused: {table}, row 3, column name: {refusal}"])


def test_jobs_are_read_from_lines_or_a_list(tmp_path):
    other = {**HOLD, "name": "b"}
    lines, listed = tmp_path / "jobs.jsonl", tmp_path / "jobs.json"
    lines.write_text(f"{json.dumps(HOLD)}\n\n{json.dumps(other)}\n", encoding="utf-8")
    listed.write_text(json.dumps([HOLD, other], indent=1), encoding="utf-8")
    assert {line: job.name for line, job in read_jobs(str(lines)).items()} == {1: "a", 3: "b"}
    assert [*read_jobs(str(lines)).values()] == [*read_jobs(str(listed)).values()]
    listed.write_text(json.dumps(HOLD, indent=1), encoding="utf-8")
    assert [job.name for job in read_jobs(str(listed)).values()] == ["a"]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"{json.dumps(HOLD)}\n{{}}", "line 2: Object missing required field `name`."),
        (json.dumps(HOLD | {"repetitions": 0}), "line 1: JobSpec.repetitions must be between 1 and 100000 (got 0)."),
        (json.dumps([HOLD, HOLD | {"kind": "dance"}]), "No kind of job 'dance'. Allowed: hold, pick_place, press,"),
        (json.dumps(HOLD | {"places": ["a", "b"]}), "line 1: JobSpec.places must be one place for a hold (got a, b)."),
        (json.dumps(HOLD | {"payloadkg": 1}), "line 1: Unknown field 'payloadkg'; did you mean 'payload_kg'? Allowed:"),
        (json.dumps([HOLD | {"payloadkg": 1}]), "Unknown field 'payloadkg' in [0]; did you mean 'payload_kg'?"),
        ("{", "line 1: Input data was truncated."),
        ("\n", "contains no jobs."),
        (
            json.dumps({"jobs": [HOLD], "by": "ann"}),
            " is a Submission, the body of an HTTP request: give its list of jobs",
        ),
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


def test_faults_of_a_table_are_told_before_a_fleet_is_asked_for_its_places(tmp_path, thermofleet, monkeypatch):
    monkeypatch.delattr("scenarios.live.requests.BusClient")
    table = tmp_path / "jobs.csv"
    table.write_text("name,kind,places,payload\nd,hold,moon,heavy\n")
    assert thermofleet("job", "submit", table, "--fleet", "f").refused(
        "row 2, column payload: expected a number (got 'heavy')."
    )


def test_jobs_in_several_messages_follow_those_they_wait_for():
    words = [JobSpec(f"j{i:03d}", "hold", ("x",), after=(f"j{i + 1:03d}",) if i < 199 else ()) for i in range(200)]
    handed_in = list(batches(words))
    assert [len(part) for part in handed_in] == [64, 64, 64, 8]
    assert [word.name for part in handed_in for word in part] == [word.name for word in reversed(words)]
    ring = [JobSpec("a", "hold", ("x",), after=("b",)), JobSpec("b", "hold", ("x",), after=("a",))]
    assert list(batches(ring)) == [tuple(ring)]


def test_a_missing_file_or_auctioneer_is_one_sentence(endpoint, tmp_path, thermofleet):
    file = tmp_path / "jobs"
    file.write_text(json.dumps(HOLD))
    for name, sentence in (
        ("no-such-file", "Cannot read 'no-such-file': No such file or directory."),
        (file, "No auctioneer of fleet 'f' replied"),
    ):
        assert thermofleet("job", "submit", name, "--endpoint", endpoint, "--fleet", "f").refused(sentence)


@contextmanager
def served(endpoint: str, declare: Callable[[BusClient], None]) -> Iterator[None]:
    """A participant of fleet f on a thread."""
    with BusClient(endpoint, "f") as link:
        declare(link)
        with serving(link):
            yield


@contextmanager
def arm(endpoint: str, *, feasible: bool = True) -> Iterator[list[QuoteRequest]]:
    """An arm that only quotes; yields its requests."""
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


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 1), (signal.SIGINT, 130)])
def test_following_jobs_ends_with_a_sentence_on_a_signal(endpoint, number, code):
    def declare(bus: BusClient) -> None:
        taken = SubmissionReply("auctioneer", (Admission("hold", True),))
        waiting = Status("auctioneer", 0.0, (JobStatus("hold", "waiting"),))
        bus.reply_to(keys.of_jobs("f", "submit"), Submission, lambda _: taken)
        bus.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: waiting)

    words = ("job", "submit", "--kind", "hold", "--place", "bench", "--wait", "--endpoint", endpoint, "--fleet", "f")
    with served(endpoint, declare), commands.ready(*words) as (process, _):
        assert process.stdout is not None
        assert process.stdout.readline() == "hold: waiting\n"
        assert commands.end(process, number) == (code, "Stopped following; the auctioneer has the jobs.\n")


def test_a_list_of_jobs_has_a_line_for_each_and_ages_since_their_acceptance(endpoint, thermofleet, monkeypatch):
    """At 3600 s; `new` was accepted at 3480 s, `planned` at 60 s for 3000 s."""
    why = "It waits until the_arm_beside_the_belt is out of the way."
    jobs = (
        JobStatus("new", "waiting", reason=why, repetitions=12, due_s=3000.0, release_s=0.0, accepted_s=3480.0),
        JobStatus("planned", "waiting", reason=why, repetitions=12, release_s=3000.0, accepted_s=60.0),
    )
    declared = (keys.of_jobs("f", "status"), StatusRequest, lambda _: Status("auctioneer", 3600.0, jobs))
    listed = ("job", "list", "--endpoint", endpoint, "--fleet", "f")
    with served(endpoint, lambda bus: bus.reply_to(*declared)):
        monkeypatch.delenv("COLUMNS", raising=False)
        _, new, planned = thermofleet(*listed)[1].splitlines()  # in a pipe
        monkeypatch.setenv("COLUMNS", "80")
        _, *narrow = thermofleet(*listed)[1].splitlines()
        monkeypatch.setenv("COLUMNS", "20")
        monkeypatch.setattr(terminal.out_console, "_width", None)  # which COLUMNS may have set when it was made
        sentence, _ = thermofleet(*listed)[1].splitlines()  # wrapped by a terminal only
    assert " ".join(new.split()) == f"new waiting 0 of 12 2 min 0:50:00, 10 min late {why}"
    assert " ".join(planned.split()) == f"planned waiting 0 of 12 10 min {why}"
    assert sentence == f"new: state waiting, cycles 0 of 12, age 2 min, due 0:50:00, 10 min late, reason {why}"
    assert [line.split()[:2] for line in narrow] == [["new", "waiting"], ["planned", "waiting"]]
    assert all(len(line) <= 80 and "It waits until the_arm" in line for line in narrow)


def test_a_list_of_jobs_has_all_with_their_reasons(endpoint, thermofleet, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    desk = ManyJobs(*entries(481, "waiting", reason="Its place is in use."), *entries(300), *entries(1, "unfinished"))
    listed = ("job", "list", "--endpoint", endpoint, "--fleet", "f")
    with served(endpoint, desk.reply_on):
        _, *lines = thermofleet(*listed)[1].splitlines()
        named = thermofleet(*listed, *[*desk.entries][:300], "--json")[1]
        unknown = thermofleet(*listed, "unfinished")[2]
    assert sorted(line.split()[0] for line in lines) == sorted(desk.entries)
    assert sum("Its place is in use." in line for line in lines) == 481
    assert [job["job"] for job in json.loads(named)] == sorted([*desk.entries][:300])
    near = " ".join(unknown.split()).partition("knows no job 'unfinished'")[2]
    assert near.startswith("; did you mean 'unfinished_0000'? The most similar of 782: unfinished_0000, finished_0")
    assert near.count("finished_") == 6


def test_a_list_of_named_jobs_has_the_known_ones_and_names_the_others(endpoint, thermofleet):
    desk = ManyJobs(*entries(3, "waiting"))
    with served(endpoint, desk.reply_on):
        names = ("waiting_0001", "none", "waiting_0000", "other")
        code, out, err = thermofleet("job", "list", "--endpoint", endpoint, "--fleet", "f", *names)
    assert [line.split()[0] for line in out.splitlines()[1:]] == ["waiting_0000", "waiting_0001"]
    assert (code, " ".join(err.split())) == (2, "Error: The fleet knows no job 'none', 'other'.")


@pytest.mark.parametrize(
    ("due_s", "value", "says"),
    [(9000.0, 3.0, ", due at 2:30:00, value 3."), (None, None, ", no due date.")],
)
def test_the_reply_to_a_change_has_the_new_values(endpoint, thermofleet, due_s, value, says):
    status = JobStatus("N/3", "waiting", repetitions=5, due_s=due_s, value=value)
    reply = Controlled("auctioneer", "r", True, job=status)
    declared = (keys.of_jobs("f", "control"), ControlRequest, lambda _: reply)
    with served(endpoint, lambda bus: bus.reply_to(*declared)):
        words = ("job", "change", "N/3", "--due", "9000", "--endpoint", endpoint, "--fleet", "f")
        assert thermofleet(*words)[1] == f"N/3: waiting, 0 of 5 cycles{says}\n"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--name", " leading"), "--name must have 1 to 128 printable characters"),
        (("--place", " a"), "--place must have 1 to 128 printable characters"),
    ],
)
def test_an_invalid_job_is_told_by_the_option(thermofleet, words, says):
    code, _, err = thermofleet("job", "submit", "--kind", "hold", "--place", "a", *words)
    assert (code, says in " ".join(err.split())) == (2, True)
    assert "JobSpec" not in err


def test_a_list_of_jobs_needs_somebody_who_tells(endpoint, thermofleet):
    with served(endpoint, lambda bus: bus.declare_token(keys.of_arm("f", "arm_0", "alive"))):
        code, out, err = thermofleet("job", "list", "--endpoint", endpoint, "--fleet", "f")
    assert (code, out) == (2, "")
    assert "Nobody tells of jobs" in err


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
    assert thermofleet("job", "submit", "--quote", "--kind", "hold", "--place", "rack", *at).refused(
        "No arm of fleet 'f' replied"
    )
