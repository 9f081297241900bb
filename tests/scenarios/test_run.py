"""A shift from beginning to end: its jobs, files and trace; the same over either bus."""

import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from msgspec import structs

from agents.registry import RULES
from fleet.bus.protocol.auction import ArmEvent, ArmOffer, JobStatus, PlanQuote, Result
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause
from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import ThermalLimits
from fleet.telemetry import Telemetry
from scenarios.cli.look import last_folder
from scenarios.live.recorder import Recorder
from scenarios.live.trace import NOT_RECORDED, Thread, rows_of, thread_of, thread_table
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.result_folder import json_text
from scenarios.run.log import FILES, code_hash, telemetry_table, versions_of
from scenarios.run.records import Offer, ShiftLog
from scenarios.run.shift import RunLog, run
from scenarios.show.run_page import verdict
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import scenario_hash
from scenarios.terminal import out_console
from tests.scenarios.conftest import SMALL


@pytest.fixture(scope="module")
def small_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "heat.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def fleet(plans: Path, small_file: Path) -> Fleet:
    return prepare(load(small_file), difficulty="blind", cache=plans)


@pytest.fixture(scope="module")
def oracle(plans: Path, small_file: Path) -> Fleet:
    return prepare(load(small_file), difficulty="oracle", cache=plans)


@pytest.fixture(scope="module")
def result(fleet: Fleet) -> RunLog:
    return run(fleet, spec())


def spec(policy: str = "round_robin", seed: int = 0, **changes) -> RunSpec:
    return replace(RunSpec(policy=policy, seed=seed, bus="memory", difficulty="blind"), **changes)


def same(one: RunLog, two: RunLog) -> bool:
    pairs = zip(vars(one.readings).values(), vars(two.readings).values(), strict=True)
    alike = all(np.array_equal(a, b) for a, b in pairs)
    return alike and repr(one.events) == repr(two.events) and one.metrics == two.metrics


@pytest.mark.parametrize("policy", RULES)
def test_the_same_seed_gives_the_same_shift_without_an_illegal_action(fleet, policy):
    one, again = (run(fleet, spec(policy, 7)) for _ in range(2))
    assert same(one, again)
    assert one.metrics.illegal_actions == 0


@pytest.mark.parametrize("form", ["np.array({})", "np.array([{}])", "np.int8({})"])
def test_an_action_may_be_an_array_of_one_integer(fleet, result, tmp_path, form):
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "from agents.rules import RoundRobin\n"
        "class Wrapped(RoundRobin):\n"
        "    only_choices = True\n"
        f"    def act(self, seen): return {{arm: {form.format('a')} for arm, a in super().act(seen).items()}}\n"
    )
    assert same(run(fleet, spec(f"{file}:Wrapped")), result)


def test_offers_of_arms_without_predictions_have_none(result):
    assert result.offers
    assert {(o.difficulty, o.peak_c, o.p_saturation) for o in result.offers} == {(None, None, None)}
    assert all(o.duration_s for o in result.offers if o.feasible)


def test_another_seed_gives_another_shift(fleet, result):
    assert not same(result, run(fleet, spec(seed=1)))


def test_zenoh_and_memory_give_the_same_shift_with_its_progress(fleet, result):
    shares: list[tuple[str, float]] = []
    over_zenoh = run(fleet, spec(bus="zenoh"), progress=lambda *report: shares.append(report))
    assert same(over_zenoh, result)
    assert over_zenoh.metrics.messages > 0
    assert shares == [("working", pytest.approx(tick / 18)) for tick in range(round(result.time_s / 10) + 1)]


def test_a_stopped_shift_is_the_beginning_of_the_whole_one(fleet, result):
    counted = iter(range(100))
    part = run(fleet, spec(), stopped=lambda: next(counted) >= 5)
    assert not part.finished
    assert result.finished
    assert part.time_s == part.readings.time_s[-1] == 50.0
    assert np.array_equal(part.readings.temp_c, result.readings.temp_c[: len(part.readings.time_s)])
    assert repr(part.events) == repr(result.events[: len(part.events)])
    nothing = run(fleet, spec(), stopped=lambda: True)
    assert len(nothing.readings.time_s) == 0
    assert nothing.time_s == 0.0
    assert nothing.metrics.finished == 0
    json.dumps(nothing.card, allow_nan=False)


def test_ctrl_c_outside_the_steps_is_not_taken_for_a_result(fleet, monkeypatch):
    class Broken:
        def reset(self, rng):
            """Begin."""

        def act(self, observations):
            raise KeyboardInterrupt

    monkeypatch.setattr("scenarios.policy_loader.policy_of", lambda *name: Broken())
    with pytest.raises(KeyboardInterrupt):
        run(fleet, spec())


def test_telemetry_is_read_once_a_second_from_every_arm(fleet, result):
    assert np.array_equal(result.readings.time_s, np.arange(1, len(result.readings.time_s) + 1))
    assert result.readings.temp_c.shape == (len(result.readings.time_s), 2, 7)
    assert run(fleet, spec(), record=False).telemetry.num_rows == 0


def test_telemetry_at_the_end_of_a_step_is_what_the_policy_observes_next(fleet, monkeypatch):
    """The temperatures with the same noise."""
    seen = []

    class Watching:
        def reset(self, rng):
            """Begin."""

        def act(self, observations):
            seen.append(np.stack([each.temp_c for each in observations.values()]))
            return {arm: int(each.action_mask[1]) for arm, each in observations.items()}

    monkeypatch.setattr("scenarios.policy_loader.policy_of", lambda *name: Watching())
    telemetry = run(fleet, spec()).readings
    assert telemetry is not None
    ends = telemetry.time_s % fleet.scenario.decision_interval_s == 0
    assert len(seen) > 5
    np.testing.assert_allclose(telemetry.temp_c[ends][: len(seen) - 1], seen[1:], rtol=1e-6, atol=0)


def test_awards_state_what_the_chosen_plan_promised(fleet, oracle):
    events = run(oracle, spec("round_robin", 2, difficulty="oracle")).events
    ends = {event.job: event for event in events if event.kind == "finish"}
    stated = [event for event in events if event.kind == "award" and event.job in ends]
    assert stated
    for award in stated:
        match = re.fullmatch(r"predicted peak ([\d.]+) °C, P\(saturation\) ([01]\.\d\d)", award.reason)
        assert match is not None
        assert (float(match[1]) > fleet.scenario.limits.warning_c) == (float(match[2]) > 0.5)
    assert not any(event.reason for event in run(fleet, spec("round_robin", 2)).events if event.kind == "award")


def test_the_metrics_agree_with_the_event_log(fleet):
    result = run(fleet, spec("random", 2))
    kinds = [event.kind for event in result.events]
    m = result.metrics
    assert kinds.count("finish") == m.finished
    assert kinds.count("release") == m.jobs
    assert kinds.count("fault") == m.faults
    awards = [event for event in result.events if event.kind == "award"]
    assert len(awards) >= m.finished
    last = max(event.time_s for event in result.events if event.kind == "finish")
    assert m.makespan_s == pytest.approx(last)
    assert set(m.peak_c) == {"left", "right"}


def test_the_summary_says_how_the_run_was_made_and_holds_no_clock_time(fleet):
    page = run(fleet, spec(seed=4)).card
    assert page["status"] == "finished"
    assert page["seed"] == 4
    assert page["policy"] == "round_robin"
    assert page["bus"] == "memory"
    assert page["difficulty"] == "blind"
    assert (
        page["scenario_hash"] == scenario_hash(fleet.scenario) != scenario_hash(replace(fleet.scenario, horizon_s=190))
    )
    assert {"thermofleet", "mujoco", "python"} <= set(page["versions"])
    assert page["twins"] == {"left": {"version": "blind"}, "right": {"version": "blind"}}
    assert json.loads(json.dumps(page, allow_nan=False))["metrics"] == page["metrics"]


def test_a_disk_that_refuses_at_the_end_is_told(result, tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    shutil.rmtree(gone)
    with pytest.raises(FleetError, match=r"Cannot write to '.*gone': No such file or directory"):
        result.write(gone)


def test_the_files_of_a_run_read_back_as_documented(result, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    result.write(folder)
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    told = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert told["status"] == "finished"
    telemetry = pq.read_table(folder / "telemetry.parquet")
    joints = [f"{name}_{j}" for name in ("q", "qd", "tau", "current_a", "temp_c") for j in range(1, 8)]
    assert telemetry.column_names == ["time_s", "arm", "mode", *joints]
    assert telemetry.num_rows == 2 * round(told["time_s"])
    assert set(telemetry["arm"].to_pylist()) == {"left", "right"}
    assert set(telemetry["mode"].to_pylist()) <= {"idle", "working", "faulted"}
    events = pq.read_table(folder / "events.parquet")
    assert events.column_names == ["time_s", "kind", "arm", "job", "joint", "value", "reason"]
    assert events.num_rows == len(result.events)
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")


def test_telemetry_rows_go_arm_by_arm_within_a_moment(result):
    table = telemetry_table(result.readings, ["left", "right"])
    rows = table.slice(6, 2).to_pylist()
    assert [(row["time_s"], row["arm"]) for row in rows] == [(4.0, "left"), (4.0, "right")]
    for a, row in enumerate(rows):
        assert row["temp_c_2"] == pytest.approx(float(result.readings.temp_c[3, a, 1]), rel=1e-6)
        assert row["qd_7"] == pytest.approx(float(result.readings.qd[3, a, 6]), rel=1e-6)


LOG = [
    Event(time_s=float(i), kind=kind, arm=arm, job=job)  # pyright: ignore[reportArgumentType]
    for i, (kind, arm, job) in enumerate(
        [("release", "", "a"), ("award", "left", "a"), ("fault", "left", "a"), ("return", "left", "a"),
         ("award", "right", "a"), ("warning", "right", "a"), ("finish", "right", "a"), ("award", "left", "b")]
    )
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(oracle: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("traced") / "runs" / "one"
    out.mkdir(parents=True)
    run(oracle, spec("least_difficulty", difficulty="oracle")).write(out)
    return out


@pytest.mark.parametrize(
    ("asked", "rows"),
    [
        ("0", [0]),
        ("7", [7]),
        ("award", [1, 4, 7]),
        ("award@left", [1, 7]),
        ("award@a", [1, 4]),
        ("a", [1, 4]),
        ("b", [7]),
    ],
)
def test_events_are_named_by_row_kind_arm_and_job(asked, rows) -> None:
    assert rows_of(LOG, asked) == rows


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("8", "No event 8: rows of the event log are 0 to 7."),
        ("falt", "did you mean 'fault'"),
        ("contact", "No event of kind 'contact' was recorded. Recorded: release, award, fault"),
        ("award@lef", "No event 'award' of 'lef'; did you mean 'left'"),
    ],
)
def test_what_is_no_event_is_said_with_what_there_is(asked, said) -> None:
    with pytest.raises(FleetError, match=said.replace("(", r"\(")):
        rows_of(LOG, asked)


def test_every_event_of_a_run_leads_to_what_its_files_hold(folder: Path) -> None:
    card = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    jobs = {row["job"]: row for row in pq.read_table(folder / "jobs.parquet").to_pylist()}
    offers = pq.read_table(folder / "offers.parquet").to_pylist()
    events = pq.read_table(folder / "events.parquet").to_pylist()
    for row, event in enumerate(events):
        thread = thread_of(folder, str(row))
        assert (thread.event.kind, thread.event.time_s) == (event["kind"], event["time_s"])
        assert thread.configuration["scenario_hash"] == card["scenario_hash"]
        assert thread.code["hash"] == card["code_hash"] == code_hash()
        if event["job"]:
            assert thread.job == jobs[event["job"]]
        if event["kind"] in ("finish", "home"):
            assert thread.award is not None
            assert thread.award.arm == event["arm"]
            own = [o for o in offers if (o["time_s"], o["job"]) == (thread.award.time_s, event["job"])]
            assert [asdict(offer) for offer in thread.offers] == own
            (chosen,) = (offer for offer in thread.offers if offer.awarded)
            assert (chosen.arm, chosen.difficulty) == (event["arm"], pytest.approx(thread.award.value))
            assert chosen.plan in (0, 1)
            assert thread.twin == {"arm": event["arm"], **card["twins"][event["arm"]]}


def test_the_command_shows_one_screen_or_json(folder: Path, thermofleet, capsys, monkeypatch) -> None:
    monkeypatch.chdir(folder.parent.parent)
    assert last_folder(Path("runs")) == Path("runs/one")
    screen, text = (thermofleet("report", "--trace", "finish", *options).out for options in ([], ["--json"]))
    assert len(screen.splitlines()) < 60
    assert all(head in screen for head in ("event", "job", "award", "plan", "offers", "twin", "configuration", "code"))
    thread = thread_of(Path("runs/one"), "finish")
    odd = replace(thread.event, kind="fault", joint=2, value=75.04, reason="[bold]a[/b] of others")
    out_console.print(thread_table(replace(thread, event=odd)))
    shown = " ".join(capsys.readouterr().out.split())
    assert all(
        each in shown for each in ("[bold]a[/b] of others", "temperature 75.04 °C", "The motor of joint 2 passed")
    )
    shown = json.loads(text)
    assert (shown["event"]["kind"], shown["award"]["kind"]) == ("finish", "award")
    assert code_hash() in screen


def cells_of(thread: Thread) -> dict[str, str]:
    """Texts of the table of a trace, by the names of their rows."""
    return {row[0]: row[1] for row in thread_table(thread).rows}


def test_a_trace_has_the_times_of_day_of_its_shift(folder: Path, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    shutil.copytree(folder, begun)
    card = json.loads((begun / "run.json").read_text())
    card["scenario"] |= {"shift_begin": "2026-11-23T10:00:00+01:00", "time_zone": "Europe/Berlin"}
    (begun / "run.json").write_text(json.dumps(card))
    cells, of_day = (cells_of(thread_of(each, "finish")) for each in (folder, begun))
    for head in ("award", "job", "history"):
        assert re.search(r"\b0:0\d:\d\d", cells[head])
        assert of_day[head] == re.sub(r"\b0:(\d\d:\d\d)", r"10:\1", cells[head])
    assert "finish at 10:0" in thread_table(thread_of(begun, "finish")).caption
    assert "begin" not in thread_of(begun, "finish").as_json()


def test_a_trace_gives_the_seed_of_a_twin_without_a_separator_at_its_end(folder: Path) -> None:
    twin = {"version": "ab12", "data_hash": "cd34", "seed": "[0, 1]/"}
    thread = replace(thread_of(folder, "finish"), twin={"arm": "arm", "version": "d:ab12", "twin": twin})
    assert cells_of(thread)["trained on"] == "version ab12, data hash cd34, seed [0, 1]"


def test_a_folder_without_a_run_is_said(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FleetError, match=r"There is no run in 'runs'\. Give the folder"):
        last_folder(Path("runs"))
    with pytest.raises(FleetError, match="is neither a folder of `thermofleet run` nor of `thermofleet bus record`"):
        thread_of(tmp_path, "fault")


def test_a_recording_has_what_arms_published_and_says_what_is_missing(tmp_path: Path) -> None:
    recorder = Recorder.open(tmp_path, "f")
    log = (
        ("award", ", twin old"),
        ("return", ""),
        ("award", "plan 1, twin d:0123"),
        ("warning", "hot"),
        ("finish", ""),
    )
    recorder.add("a", State(arm="a", tick=0, time_s=0.0, mode="idle", temp_c=(), headroom_k=0.0))
    for number, (kind, reason) in enumerate(log):
        recorder.add("a", ArmEvent(arm="a", number=number, time_s=10.0 * number, kind=kind, job="j", reason=reason))
    status = JobStatus(job="j", state="awarded", arm="a", value=2.0, release_s=5.0, due_s=3725.0)
    for number, time_s in enumerate((1.0, 21.0)):
        quoted = PlanQuote(difficulty=time_s, p_saturation=0.1, duration_s=60.0)
        offers = (ArmOffer("a", "idle", True, quoted), ArmOffer("b", "working", False))
        awarded = structs.replace(status, award=f"award {number}")
        recorder.add(
            "boss",
            Result("boss", number=number, time_s=time_s, status=awarded, offers=offers, difficulty=time_s),
        )
    for number, name in enumerate(("k", "7"), start=2):
        waits = JobStatus(job=name, state="waiting", value=2.0, release_s=5.0, due_s=15.0)
        recorder.add("boss", Result("boss", number=number, time_s=22.0, status=waits))
    recorder.add("a", ArmEvent(arm="a", number=len(log), time_s=22.0, kind="lost", job="k", reason="another claim"))
    request = ControlRequest("r", Pause("*"), "ann")
    recorder.add("boss", Operation("boss", 30.0, request, 1))
    recorder.write(status="finished")
    first = thread_of(tmp_path, "j")
    assert first.award is not None
    assert (first.award.time_s, first.job["award"], first.job["difficulty"]) == (0.0, "award 0", 1.0)
    with pytest.raises(FleetError, match=r"'pause' is a request or an alarm, which has no causes .* award, return, "):
        thread_of(tmp_path, "pause")
    for asked in ("k", "award@k"):
        why = r"No award of 'k' is recorded; its state is waiting\. k is unfinished .* Trace another event: lost@k\."
        with pytest.raises(FleetError, match=why):
            thread_of(tmp_path, asked)
    with pytest.raises(FleetError, match=r"No event 7: rows of the event log are 0 to 5"):
        thread_of(tmp_path, "7")
    thread = thread_of(tmp_path, "warning")
    assert thread.award is not None
    assert (thread.award.time_s, thread.twin) == (20.0, {"arm": "a", "version": "d:0123"})
    assert [event.kind for event in thread.history] == [kind for kind, _ in log]
    assert [(o.arm, o.awarded, o.feasible, o.difficulty) for o in thread.offers] == [
        ("a", True, True, 21.0),
        ("b", False, False, None),
    ]
    assert (thread.job["award"], thread.job["difficulty"]) == ("award 1", 21.0)
    assert (thread.job["value"], thread.code["hash"]) == (2.0, NOT_RECORDED)
    assert "state awarded, release 0:00:05, due 1:02:05, value 2" in cells_of(thread)["job"]
    assert json.loads(json_text(thread.as_json()))["event"]["kind"] == thread.event.kind


ARMS = ("hot", "cool")
MIN = 60.0


def event(minute, kind, arm, job, **more):
    return Event(time_s=minute * MIN, kind=kind, arm=arm, job=job, **more)


EVENTS = (
    event(0, "award", "hot", "hold-1"),
    event(20, "finish", "hot", "hold-1", value=0.0),
    event(20, "home", "hot", "hold-1"),
    event(20.5, "award", "hot", "hold-2"),
    event(25, "award", "cool", "sort-1"),
    event(30, "fault", "hot", "hold-2", joint=2, value=75.0, reason="joint 2 passed 75 °C"),
    event(30, "return", "hot", "hold-2", value=1.0),
    event(50, "recover", "hot", ""),
    event(55, "finish", "cool", "sort-1", value=0.0),
    event(55, "home", "cool", "sort-1"),
)


def offer(arm, peak_c, *, at=20.5, **more):
    of = {"state": "idle", "feasible": True, "free": True, "difficulty": 5.0, "duration_s": 600.0, "p_saturation": 1.0}
    return Offer(time_s=at * MIN, job="hold-2", arm=arm, awarded=arm == "hot", peak_c=peak_c, **{**of, **more})


def sentences(*offers, events=EVENTS, end=60):
    return told({"status": "finished", "time_s": end * MIN}, events, offers)


def told(card, events=(), offers=()):
    readings = Telemetry.empty(len(ARMS))
    log = ShiftLog(card=card, arms=ARMS, limits=ThermalLimits(), readings=readings, events=events, offers=offers)
    return verdict(log).sentences


def test_a_fault_is_told_with_its_arm_joint_time_and_cause():
    fault, why, _, remedy = sentences(offer("hot", 78.2), offer("cool", 50.0))
    assert fault == "0:30:00: hot stopped during hold-2, out for 20 min: the motor of joint 2 passed 75 °C."
    assert why.startswith("Why: at work without a pause since 0:00:00; at the award, 0:20:30, predicted peak 78 °C ")
    assert remedy.startswith("The fault was predicted")
    assert len(sentences(offer("hot", 74.0), offer("cool", 50.0))) == 3


@pytest.mark.parametrize(
    ("own_c", "other", "end", "told"),
    [
        (78.0, {"peak_c": 50.0}, 60, "giving the job to cool, predicted peak 50 °C: it was free."),
        (78.0, {"peak_c": 72.0, "free": False}, 60, "predicted peak 72 °C, but its place or space was taken."),
        (78.0, {"peak_c": 73.0}, 60, "until hot had cooled: no other arm could do the job cooler."),
        (78.0, {"peak_c": None, "feasible": False}, 60, "had cooled: no other arm could do the job."),
        (70.0, {"peak_c": 68.0}, 60, "below the limit, and no other arm could do the job cooler."),
    ],
)  # fmt: skip
def test_the_choice_that_would_have_avoided_a_fault(own_c, other, end, told):
    assert sentences(offer("hot", own_c), offer("cool", **other), end=end)[2].endswith(told)


@pytest.mark.parametrize(("end", "told"), [(60, "once it was free, at 0:55:00."), (55, "which was busy to the end.")])
def test_a_cooler_arm_at_work_is_named_with_the_end_of_its_job(end, told):
    events = (EVENTS[0], event(10, "award", "cool", "sort-1"), *EVENTS[1:4], *EVENTS[5:])
    busy = offer("cool", 50.0, free=False, state="working")
    assert sentences(offer("hot", 78.0), busy, events=events, end=end)[2].endswith(told)


def test_without_offers_only_the_work_is_told_and_without_a_fault_the_hottest_motor():
    assert sentences()[1:] == ("Why: at work without a pause since 0:00:00; no prediction was recorded.",)
    assert told({"metrics": {"peak_c": {"hot": 68.2, "cool": float("nan")}}}) == (
        "No motor reached its error limit; the hottest, in hot, reached 68 °C.",
    )


def test_a_library_that_is_not_installed_has_no_version():
    versions = versions_of(("numpy", "no-such-library"))
    assert versions["numpy"] == np.__version__
    assert versions["no-such-library"] is None
