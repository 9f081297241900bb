"""The command line, called as a person calls it."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

from scenarios.run.log import FILES
from scenarios.spec.load import library
from scenarios.suite.instances import CELLS
from tests.commands import REAL

QUICK = ("--difficulty", "blind", "--bus", "memory", "--policy", "round_robin")


def run_json(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def test_a_run_prints_its_figures_and_leaves_four_files(thermofleet, small_toml, tmp_path):
    out = tmp_path / "run"
    said = thermofleet("run", small_toml, *QUICK, "--out", out)
    assert said.code == 0
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    told = run_json(out)
    assert told["status"] == "finished"
    for label in ("jobs finished", "value", "on time", "faults", "min above warning", "energy, Wh"):
        assert label in said.out
    assert f"{told['metrics']['finished']} of {told['metrics']['jobs']}" in said.out
    for arm, peak_c in told["metrics"]["peak_c"].items():
        assert f"peak {arm}, °C" in said.out
        assert f"{peak_c:.1f}" in said.out
    assert str(out / "report.html") in said.out
    assert said.err == ""


@pytest.mark.parametrize("plant", ["profile", "mujoco"])
def test_the_same_seed_gives_the_same_files(thermofleet, small_toml, tmp_path, plant):
    one, two = tmp_path / "one", tmp_path / "two"
    for out in (one, two):
        assert thermofleet("run", small_toml, *QUICK, "--plant", plant, "--seed", 3, "--out", out).code == 0
    for name in FILES:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


def test_the_same_seed_gives_the_same_files_in_another_process(thermofleet, small_toml, tmp_path, plans):
    one, two = tmp_path / "one", tmp_path / "two"
    assert thermofleet("run", small_toml, *QUICK, "--out", one).code == 0
    env = {**os.environ, "THERMOFLEET_CACHE": str(plans), "PYTHONHASHSEED": "7"}
    command = [*REAL, "run", str(small_toml), *QUICK]
    subprocess.run([*command, "--out", str(two)], check=True, env=env, capture_output=True, timeout=300)
    for name in FILES:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


def test_zenoh_and_memory_record_the_same_shift(thermofleet, small_toml, tmp_path):
    for bus in ("zenoh", "memory"):
        assert thermofleet("run", small_toml, *QUICK, "--bus", bus, "--out", tmp_path / bus).code == 0
    for name in ("telemetry.parquet", "events.parquet"):
        assert (tmp_path / "zenoh" / name).read_bytes() == (tmp_path / "memory" / name).read_bytes(), name


def test_json_is_one_object_and_nothing_else(thermofleet, small_toml, tmp_path):
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run", "--json")
    told = json.loads(said.out)
    assert told["out"] == str(tmp_path / "run")
    assert told["metrics"] == run_json(tmp_path / "run")["metrics"]


def test_without_out_the_run_goes_into_runs(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert thermofleet("run", small_toml, *QUICK, "--seed", 5).code == 0
    assert (tmp_path / "runs" / "heat-round_robin-5" / "run.json").is_file()


def test_a_finished_run_is_kept_until_told_otherwise(thermofleet, small_toml, tmp_path):
    out = tmp_path / "run"
    assert thermofleet("run", small_toml, *QUICK, "--out", out).code == 0
    said = thermofleet("run", small_toml, *QUICK, "--seed", 1, "--out", out)
    assert said.code == 2
    assert run_json(out)["seed"] == 0
    assert thermofleet("run", small_toml, *QUICK, "--seed", 1, "--out", out, "--overwrite").code == 0
    assert run_json(out)["seed"] == 1


def test_list_names_every_scenario_of_the_library(thermofleet):
    said = thermofleet("show")
    assert said.code == 0
    assert all(name in said.out for name in library())
    assert set(json.loads(thermofleet("show", "--json").out)) == set(library())


def test_show_lists_the_cells_and_the_instances_of_a_split(thermofleet):
    names = [row["name"] for row in json.loads(thermofleet("show", "--suite", "test", "--json").out)]
    assert names[:2] == ["test/0000", "test/0001"]
    assert all(name in thermofleet("show", "--suite", "test").out for name in names[:2])
    cells = json.loads(thermofleet("show", "--suite", "cells", "--json").out)
    assert set(cells) == {cell.name for cell in CELLS}


def test_show_fits_eighty_columns_and_cuts_no_word(thermofleet, small_toml):
    said = thermofleet("show", small_toml)
    assert said.code == 0
    assert max(len(line.rstrip()) for line in said.out.splitlines()) <= 80
    assert "…" not in said.out
    assert "hold 2 kg at bench, 1–2 × 10 s" in said.out
    assert "sort shelf → bench, 0.2 or 0.5 kg, 1–3 times" in said.out
    assert "2 at 0 s" in said.out
    assert "thermal load factor" in said.out
    assert json.loads(thermofleet("show", small_toml, "--json").out)["name"] == "heat"


def test_compare_prints_a_table_or_json(thermofleet, small_toml, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    some = ("compare", small_toml, "--seeds", 2, "--policies", "random, round_robin", "--difficulty", "blind")
    told = json.loads(thermofleet(*some, "--json").out)
    assert set(told["figures"]) == {"random", "round_robin"}
    assert "min above warning" in thermofleet(*some).out


def test_without_round_robin_the_first_policy_is_the_baseline(thermofleet, small_toml, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    some = ("compare", small_toml, "--seeds", 2, "--difficulty", "blind", "--json", "--policies")
    for policies, baseline in (("random,coolest_first", "random"), ("random,round_robin", "round_robin")):
        assert json.loads(thermofleet(*some, policies).out)["baseline"] == baseline


@pytest.mark.ci_slow
def test_the_demo_sets_two_policies_side_by_side(thermofleet, tmp_path, monkeypatch, plans):
    from scenarios.prepare.fleet import prepare

    def without_twins(scenario, *, difficulty, risk, progress):
        return prepare(scenario, difficulty="blind", cache=plans, progress=progress)

    monkeypatch.setattr("scenarios.prepare.fleet.prepare", without_twins)
    said = thermofleet("demo", "--out", tmp_path / "demo")
    assert said.code == 0
    head = said.out.splitlines()[1].split()
    assert head == ["round_robin", "wsept"]
    for policy in head:
        told = run_json(tmp_path / "demo" / policy)
        assert (told["policy"], told["status"], told["scenario"]["name"]) == (policy, "finished", "quickstart")
        assert f"{told['metrics']['energy_wh']:.0f}" in said.out
        assert str(tmp_path / "demo" / policy / "report.html") in said.out
    page = (tmp_path / "demo" / "index.html").read_text(encoding="utf-8")
    for link in re.findall(r'href="([^"]+)"', page):
        assert (tmp_path / "demo" / link).is_file()
    assert page.count("<section>") == page.count("href=") == 2
