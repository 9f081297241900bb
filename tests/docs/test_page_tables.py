"""Tables of the pages from small results whose cells are worked out by hand."""

import json
import math

from scenarios.evaluate.rollout import FIGURES, Outcome
from scenarios.evaluate.store import opened
from scenarios.evaluate.study import SHIFTS, Key, Row
from scenarios.studies.page_tables.ablations import ablation_tables
from scenarios.studies.page_tables.cells import difference
from scenarios.studies.page_tables.cooling import cooling_tables
from scenarios.studies.page_tables.policies import live_table
from scenarios.studies.page_tables.steps import steps_table


def cells(text: str) -> list[list[str]]:
    """The rows of a Markdown table without its headings."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]


def test_a_difference_is_bold_if_its_interval_excludes_zero() -> None:
    assert difference(-6.04, -10.36, -2.5) == "**−6.0 (−10.4 … −2.5)**"
    assert difference(0.5, -1.0, 2.0, 2) == "+0.50 (−1.00 … +2.00)"
    assert difference(0.0, math.nan, math.nan) == "+0.0"
    assert difference(1.0, None, None) == "+1.0"


def test_an_ablation_has_means_and_differences_to_the_first_source(tmp_path) -> None:
    folder = tmp_path / "twin_windows" / "heat_wave"
    folder.mkdir(parents=True)
    plan = {"policy": "wspt", "scores": ["blind", "trained-4s-32"], "fleets": 2, "trainings": 1, "seeds": 2}
    (folder / "ablation.json").write_text(json.dumps({"scenario": "heat_wave", "plan": {**plan, "first_seed": 5}}))
    rows = [
        (scores, fleet, 0, seed, 1.0 if scores == "blind" else 0.0, 10.0 * fleet + seed + more, 7.0)
        for scores, more in (("blind", 2.0), ("trained-4s-32", 0.0))
        for fleet in range(2)
        for seed in (5, 6, 7)  # the plan has two seeds
    ]
    head = "scores,fleet,training,seed,faults,value,reward"
    (folder / "ablation.csv").write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    (tmp_path / "twin_windows" / "active_waiting").symlink_to(folder)
    text = ablation_tables(tmp_path)["twin_windows"]()
    faults, value, reward, *_ = cells(text)
    assert faults[:2] == ["`heat_wave`: faults", "0.00"]
    assert value[1] == "10.5"  # of 5, 6, 15 and 16
    assert value[4].startswith("+2.0")
    assert value[2:4] == ["–", "–"]  # sources that were not measured
    assert reward[1] == "7.0"
    assert "`heat_wave`: 2 fleets × 2 seeds" in text


def test_a_folder_of_compare_is_read_like_one_of_an_ablation(tmp_path) -> None:
    folder = tmp_path / "ablations" / "mpc_heat_wave"
    blank = dict.fromkeys(FIGURES, 0.0)
    with opened(folder, SHIFTS, {"instances": {}, "policies": {}}) as store:
        for policy, source, more in (("mpc", "rc", 2.0), ("wsept", "rc", 0.0)):
            for fleet, seed in ((0, 5), (0, 6), (1, 5), (1, 6)):
                outcome = Outcome(**blank | {"value": 10.0 * fleet + seed + more})
                store.add([Row(Key(policy, "heat_wave", fleet, 0, source, seed), outcome)])
    text = ablation_tables(tmp_path)["mpc_parts"]()
    _, value, *_ = cells(text)
    assert value[1] == "12.5"  # of 7, 8, 17 and 18
    assert value[7].startswith("−2.0")
    assert value[2:7] == ["–"] * 5
    assert "`heat_wave`: 2 fleets × 2 seeds" in text


def test_cooling_has_differences_of_value_to_the_first_way(tmp_path) -> None:
    def row(cooling: str, mean: float, change: float) -> dict[str, object]:
        value = {"mean": mean, "difference": change, "difference_low": change - 1, "difference_high": change + 1}
        return {
            "cooling": cooling,
            "policy": "p",
            "figures": {"value": value, "faults": {"mean": 0.25}, "above_warning_min": {"mean": 12.4}},
        }

    fleet = [row("still_air", 10.0, 0.0), row("liquid", 12.0, 2.0)]
    file = {"scenario": "hall", "fleet": fleet, "joint": [], "motor": []}
    (tmp_path / "cooling_hall.json").write_text(json.dumps(file))
    assert cells(cooling_tables(tmp_path)["cooling_hall"]()) == [
        ["`still_air`", "10.0", "0.25", "12"],
        ["`liquid`", "12.0; **+2.0 (+1.0 … +3.0)**", "0.25", "12"],
    ]


def test_steps_are_ranges_over_policies() -> None:
    def row(policy: str, events: int, choices: int) -> dict[str, object]:
        every = {"env": 100, "env_choices": 10, "arm": 400, "arm_choices": 4}
        some = {"env": events, "env_choices": choices, "arm": 4 * events, "arm_choices": events}
        return {"scenario": "hall", "policy": policy, "interval": every, "events": some}

    text = steps_table({"rows": [row("a", 20, 10), row("b", 50, 50)]})
    assert cells(text) == [["`hall`", "100", "20–50", "2–5", "10.0 %", "50–100 %", "1.0 %", "25 %"]]


def test_a_live_shift_stands_beside_the_simulated_one() -> None:
    row = {
        "policy": "wspt",
        "scope": "central",
        "simulated": {"finished": 65, "faults": 0},
        "live": {"finished": 66, "faults": 1},
    }
    assert cells(live_table({"rows": [row]})) == [["`wspt`", "central", "65", "0", "66", "1"]]
