"""The thread of an event: what it shows is what the files of the run and its twins hold."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fleet.bus.protocol.auction import ArmEvent, ArmOffer, JobStatus, PlanQuote, Result
from fleet.errors import FleetError
from fleet.events import Event
from scenarios.cli.look import last_folder
from scenarios.cli.main import main
from scenarios.cli.terminal import out_console
from scenarios.live.recorder import Recorder
from scenarios.prepare.fleet import prepare
from scenarios.run.log import code_hash
from scenarios.run.shift import run
from scenarios.show.trace import NOT_RECORDED, rows_of, thread_of, thread_table
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec

JOBS = ("a", "b")
LOG = [
    Event(time_s=float(i), kind=kind, arm=arm, job=job)  # pyright: ignore[reportArgumentType]
    for i, (kind, arm, job) in enumerate(
        [("release", "", "a"), ("award", "left", "a"), ("fault", "left", "a"), ("return", "left", "a"),
         ("award", "right", "a"), ("warning", "right", "a"), ("finish", "right", "a"), ("award", "left", "b")]
    )
]  # fmt: skip


@pytest.fixture
def folder(small_toml: Path, plans: Path, tmp_path: Path) -> Path:
    out = tmp_path / "runs" / "one"
    out.mkdir(parents=True)
    fleet = prepare(load(small_toml), difficulty="oracle", cache=plans)
    run(fleet, RunSpec(policy="least_difficulty", bus="memory", difficulty="oracle")).write(out)
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


def test_the_command_shows_one_screen_or_json(folder: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(folder.parent.parent)
    assert last_folder(Path("runs")) == Path("runs/one")
    for options in ([], ["--json"]):
        with pytest.raises(SystemExit) as ended:
            main(["trace", "finish", *options])
        assert ended.value.code in (0, None)
    screen, text = capsys.readouterr().out.split("{", 1)
    assert len(screen.splitlines()) < 60
    assert all(head in screen for head in ("event", "job", "award", "plan", "offers", "twin", "configuration", "code"))
    thread = thread_of(Path("runs/one"), "finish")
    odd = replace(thread, event=replace(thread.event, reason="[bold]a[/b] of others"))
    out_console.print(thread_table(odd))
    assert "[bold]a[/b] of others" in capsys.readouterr().out
    shown = json.loads("{" + text)
    assert (shown["event"]["kind"], shown["award"]["kind"]) == ("finish", "award")
    assert code_hash() in screen


def test_a_folder_without_a_run_is_said(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FleetError, match="There is no run in 'runs'; name the folder"):
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
    for number, (kind, reason) in enumerate(log):
        recorder.add("a", ArmEvent(arm="a", number=number, time_s=10.0 * number, kind=kind, job="j", reason=reason))
    status = JobStatus(job="j", state="awarded", arm="a", value=2.0)
    for number, time_s in enumerate((1.0, 21.0)):
        quoted = PlanQuote(difficulty=time_s, p_saturation=0.1, duration_s=60.0)
        offers = (ArmOffer("a", "idle", True, quoted), ArmOffer("b", "working", False))
        recorder.add("boss", Result(auctioneer="boss", number=number, time_s=time_s, status=status, offers=offers))
    recorder.write(status="finished")
    recorder.close()
    thread = thread_of(tmp_path, "warning")
    assert thread.award is not None
    assert (thread.award.time_s, thread.twin) == (20.0, {"arm": "a", "version": "d:0123"})
    assert [event.kind for event in thread.history] == [kind for kind, _ in log]
    assert [(o.arm, o.awarded, o.feasible, o.difficulty) for o in thread.offers] == [
        ("a", True, True, 21.0),
        ("b", False, False, None),
    ]
    assert (thread.job["value"], thread.code["hash"]) == (2.0, NOT_RECORDED)
    assert json.dumps(thread.as_json(), allow_nan=False)
