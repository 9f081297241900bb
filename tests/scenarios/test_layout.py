"""Layout of cells: space in the prepared fleet, problems all at once, and `thermofleet layout`."""

import json
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest

from fleet.errors import FleetError, ScenarioError
from scenarios.cli.main import main
from scenarios.prepare.fleet import prepare, prepare_arm
from scenarios.show.layout import layout_report
from scenarios.spec.jobs import all_works
from scenarios.spec.load import library, load
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import Ambient


@pytest.fixture
def cache(plans, monkeypatch):
    """The folder of plans that all tests share."""
    monkeypatch.setenv("THERMOFLEET_CACHE", str(plans))
    return plans


def cell(*arms, places, clearance_m=0.02, **more):
    jobs = [
        {"name": f"hold_{name}", "kind": "hold", "places": [name], "payload_kg": [1.0], "dwell_s": 2.0, **more}
        | {"arrivals": {"kind": "batch", "count": 1}}
        for name in places
    ]
    raw = {"name": "cell", "description": "A cell.", "horizon_s": 600.0, "arms": list(arms), "jobs": jobs}
    raw |= {"places": [{"name": name, "position_m": list(at)} for name, at in places.items()]}
    return parse_scenario({**raw, "clearance_m": clearance_m, "planning": {"elbows": 1}}, Path("cell.toml"))


def arm(name, x, y, yaw=0.0, **more):
    return {"name": name, "position_m": [x, y, 0.0], "tilt_deg": [0.0, 0.0, yaw], **more}


APART = (arm("west", -0.6, 0.0, home="retract"), arm("east", 0.6, 0.0, 180.0, home="retract"))
TOGETHER = (arm("west", -0.45, 0.0), arm("east", 0.45, 0.0, 180.0), arm("north", 0.0, 0.45, 270.0))
LIBRARY = [pytest.param(name, marks=pytest.mark.slow if name == "scale_64" else ()) for name in sorted(library())]
PLACES = {"middle": (0.0, 0.0, 0.25), "left": (-0.9, 0.3, 0.25), "moon": (9.0, 0.0, 0.2)}


@pytest.mark.parametrize("name", LIBRARY)
def test_three_arms_of_every_library_cell_can_work_at_once(name, cache):
    report = layout_report(load(name))
    assert report.problems == ()
    assert len(report.at_once) >= 3
    assert report.excluded_share < 0.3
    for place in load(name).places:
        here = [entry for entry in report.reach if entry.place == place.name]
        assert sum(entry.payload_kg is not None or "this arm's limit" in entry.reason for entry in here) >= 2


@pytest.mark.parametrize("name", sorted({*library()} - {"scale_64"}))
def test_the_largest_set_is_the_one_that_trying_all_finds(name, cache):
    scenario = load(name)
    fleet = prepare(scenario, difficulty="blind", cache=cache)
    choices = []
    for each in fleet.arms:
        plans = [variants[0] for variants in each.plans.values()] + [v[-1] for v in each.plans.values()]
        volumes, conflicts = fleet.space.rows(plans)
        choices.append([None, *dict.fromkeys(zip(volumes.tolist(), (p.work.stations for p in plans), strict=True))])
    most = 0
    for chosen in product(*choices):
        work = [c for c in chosen if c is not None]
        if len(work) > most and not any(
            conflicts[a, b] or set(one) & set(other) for (a, one), (b, other) in combinations(work, 2)
        ):
            most = len(work)
    assert len(layout_report(scenario).at_once) == most


def test_an_arm_alone_has_the_plans_it_has_in_the_fleet(cache):
    scenario = load("quickstart")
    fleet = prepare(scenario, difficulty="blind", cache=cache)
    for whole in fleet.arms:
        alone = prepare_arm(scenario, whole.robot.name, difficulty="blind", cache=cache)
        assert list(alone.plans) == list(whole.plans)
        for work, variants in whole.plans.items():
            assert [(p.elbow, p.speed) for p in alone.plans[work]] == [(p.elbow, p.speed) for p in variants]


def test_a_work_that_comes_too_close_to_a_home_is_infeasible_and_says_so(cache):
    beside = arm("beside", 0.05, -0.5, 90.0)
    places = {"middle": PLACES["middle"]}
    fleet = prepare(cell(APART[0], beside, places=places), difficulty="blind", cache=cache)
    (error,) = fleet.infeasible
    assert (error.arm, error.place) == ("west", "middle")
    assert "beside (" in error.reason
    assert error.reason.endswith(") at home")
    alone = prepare(cell(APART[0], places=places), difficulty="blind", cache=cache)
    assert alone.infeasible == ()


def test_clearance_changes_the_space(cache):
    scenario = load("quickstart")
    shares = []
    for clearance_m in (0.0, 0.02, 0.06):
        fleet = prepare(replace(scenario, clearance_m=clearance_m), difficulty="blind", cache=cache)
        plans = [variants[0] for each in fleet.arms for variants in each.plans.values()]
        volumes, conflicts = fleet.space.rows(plans)
        shares.append(conflicts[np.ix_(volumes, volumes)].mean())
    assert shares == sorted(shares)
    assert shares[0] < shares[-1]
    for wrong in (-0.01, 0.21, float("nan")):
        with pytest.raises(ValueError, match=r"clearance_m must be between 0 and 0\.2 m"):
            replace(scenario, clearance_m=wrong)


def test_problems_are_reported_all_at_once(cache):
    with pytest.raises(ScenarioError) as error:
        prepare(cell(*TOGETHER, places=PLACES), difficulty="blind", cache=cache)
    lines = str(error.value).splitlines()
    assert [line for line in lines if "at home 'west' (" in line and "'east' (" in line]
    assert [line for line in lines if "at home 'west' (" in line and "'north' (" in line]
    assert [line for line in lines if "no arm can do 'hold_moon'" in line]
    report = layout_report(cell(*TOGETHER, places=PLACES))
    assert list(report.problems) == lines
    with pytest.raises(FleetError, match="at home 'west'"):
        prepare_arm(cell(*TOGETHER, places=PLACES), "west", difficulty="blind", cache=cache)


def test_the_command_shows_the_cell_and_fails_if_there_are_problems(cache, tmp_path, capsys):
    def call(*arguments):
        with pytest.raises(SystemExit) as stop:
            main(["layout", *map(str, arguments)])
        said = capsys.readouterr()
        return stop.value.code, said.out, said.err

    picture = tmp_path / "new" / "cell.png"
    code, out, _ = call("quickstart", "--out", picture)
    assert code == 0
    assert "At most 4 of 4 arms can work at once" in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    code, _, err = call("quickstart", "--out", picture)
    assert (code, "exists" in err or "overwrite" in err) == (2, True)
    code, _, err = call("quickstart", "--out", tmp_path / "cell.jpg")
    assert (code, "must end in .png" in err) == (2, True)
    code, out, _ = call("quickstart", "--json")
    shown = json.loads(out)
    assert (code, shown["problems"], len(shown["at_once"])) == (0, [], 4)
    text = Path(library()["quickstart"]).read_text(encoding="utf-8").replace('home = "retract"', "")
    file = tmp_path / "near.toml"
    file.write_text(text.replace("[-0.58, -0.42", "[-0.4, -0.42").replace("[0.58, -0.42", "[0.4, -0.42"))
    code, _, err = call(file)
    assert code == 2
    assert "Error: near.toml: arms: at home 'arm_0' (" in err


def test_every_work_of_the_library_has_a_volume(cache):
    scenario = load("heat_wave")
    fleet = prepare(scenario, difficulty="blind", cache=cache)
    assert {work for _, work, _, _ in fleet.space.volume} == set(all_works(scenario))


def test_stations_side_by_side_are_for_one_arm_at_a_time(cache):
    close = {"middle": (0.0, 0.0, 0.25), "beside": (0.0, 0.12, 0.25)}
    report = layout_report(cell(*APART, places=close))
    assert len(report.at_once) == 1
    (pair, *_) = [pair for pair in report.exclusions if not pair.same_place]
    assert (set(pair.jobs), pair.share) == ({"hold_middle", "hold_beside"}, 1.0)
    apart = layout_report(cell(*APART, places={"left": (-0.9, 0.3, 0.25), "right": (0.9, 0.3, 0.25)}))
    assert (len(apart.at_once), apart.excluded_share, apart.exclusions) == (2, 0.0, ())


def test_an_arm_that_never_settles_at_home_is_a_problem_of_the_cell(cache):
    unventilated = cell(APART[0] | {"cooling_factor": 0.01}, APART[1], places={"left": (-0.9, 0.3, 0.25)})
    (problem,) = layout_report(unventilated).problems
    assert problem.startswith("cell.toml: arms[0]: Arm 'west' has no steady state when idle at home")
    assert layout_report(replace(unventilated, start="cold")).problems == ()


def test_a_shift_that_begins_below_the_lower_limit_is_a_problem_of_the_cell(cache):
    cold = replace(cell(*APART, places={"left": (-0.9, 0.3, 0.25)}), ambient=Ambient(points=((0.0, -5.0),)))
    first, second = layout_report(replace(cold, start="cold")).problems
    assert first.startswith("cell.toml: arms[0]: a motor of 'west' begins at -")
    assert "°C, below limits.lower_c (0 °C); give it warmer air, or begin with" in first
    assert second.startswith("cell.toml: arms[1]")
    assert layout_report(cold).problems == ()  # powered for hours, its idle heat keeps every motor above 0 °C
