"""The film of a shift: as many frames as asked for, as long as asked for, and of the shift that `run` records."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from agents.registry import make_policy
from fleet.env.render.picture import Picture
from fleet.env.render.scene import mount_kind, scene_of
from scenarios.cell_layout import cell_of
from scenarios.cli.animate import FRAMES
from scenarios.load import library, load
from scenarios.prepare.fleet import make_env
from scenarios.report.gif import HOLD_S

WHOLE = 1
"""Seed of a shift that lasts to its horizon."""
QUICK = ("--difficulty", "blind", "--policy", "round_robin", "--size", "480x320")
TICKS = 18
"""Of the small scenario."""


def read(path: Path) -> tuple[list[np.ndarray], list[float]]:
    """Frames, uint8 [height, width, 3], and how long each stands, s."""
    frames, lasts_s = [], []
    with Image.open(path) as film:
        for i in range(getattr(film, "n_frames", 1)):
            film.seek(i)
            frames.append(np.array(film.convert("RGB")))
            lasts_s.append(film.info["duration"] / 1000)
    return frames, lasts_s


@pytest.mark.parametrize(
    ("options", "count", "seconds"),
    [((), TICKS + 1, 20.0), (("--every", 5, "--seconds", 2), 5, 2.0), (("--every", 18, "--seconds", 1), 2, 1.0)],
)
def test_a_film_has_the_beginning_the_steps_and_the_end(thermofleet, small_toml, tmp_path, options, count, seconds):
    out = tmp_path / "new" / "film.gif"
    said = thermofleet("animate", small_toml, *QUICK, "--seed", WHOLE, *options, "--out", out)
    assert said.code == 0, said.err
    frames, lasts_s = read(out)
    assert len(frames) == count
    assert {frame.shape for frame in frames} == {(320, 480, 3)}
    assert sum(lasts_s) == pytest.approx(seconds + HOLD_S, rel=0.03)
    assert lasts_s[-1] == pytest.approx(lasts_s[0] + HOLD_S)
    assert f"Drew {count} frames" in said.out
    assert str(out) in said.out
    assert [path.name for path in out.parent.iterdir()] == ["film.gif"]


def test_it_shows_the_shift_that_run_records(thermofleet, small_toml, tmp_path):
    """The last frame is the picture of the state in which the same policy leaves the same seed, drawn here."""
    out, folder = tmp_path / "film.gif", tmp_path / "run"
    assert thermofleet("animate", small_toml, *QUICK, "--seed", 3, "--out", out).code == 0
    run = ("--difficulty", "blind", "--policy", "round_robin", "--bus", "memory", "--seed", 3, "--out", folder)
    assert thermofleet("run", small_toml, *run).code == 0
    env = make_env(small_toml, difficulty="blind")
    policy = make_policy("round_robin")
    env.reset(seed=3)
    policy.reset(np.random.default_rng(0))
    while env.agents:
        env.step(policy.act(env.knowledge()))
    told = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert told["metrics"]["finished"] == int((env.truth.finished_s[0] >= 0).sum()) > 0
    scenario = load(small_toml)
    title = f"{scenario.name} · round_robin · seed 3"
    expected = Picture((480, 320)).frame(scene_of(env.world, env.truth, cell_of(scenario), title=title))
    last = read(out)[0][-1]
    apart = np.abs(last.astype(int) - expected.astype(int)).max(axis=-1)
    assert (apart == 0).mean() > 0.9  # areas are exact
    assert (apart > 24).mean() < 0.002  # soft edges nearly so


def test_the_same_seed_gives_the_same_film(thermofleet, small_toml, tmp_path):
    films = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert thermofleet("animate", small_toml, *QUICK, "--seed", seed, "--out", tmp_path / f"{name}.gif").code == 0
        films.append((tmp_path / f"{name}.gif").read_bytes())
    assert films[0] == films[1] != films[2]


def test_a_film_is_kept_until_told_otherwise(thermofleet, small_toml, tmp_path):
    out = tmp_path / "film.gif"
    out.write_text("mine", encoding="utf-8")
    said = thermofleet("animate", small_toml, *QUICK, "--out", out)
    assert (said.code, out.read_text("utf-8")) == (2, "mine")
    assert said.err == f"Error: '{out}' exists; give another --out, or --overwrite to replace it.\n"
    assert thermofleet("animate", small_toml, *QUICK, "--seed", WHOLE, "--out", out, "--overwrite").code == 0
    assert len(read(out)[0]) == TICKS + 1


def test_without_out_it_goes_into_runs(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert thermofleet("animate", small_toml, *QUICK, "--seed", 5).code == 0
    assert (tmp_path / "runs" / "heat-round_robin-5.gif").is_file()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--size", "big"), "--size must be WIDTHxHEIGHT from 320x240 to 3840x2160 (got 'big')."),
        (("--size", "100x100"), "--size must be WIDTHxHEIGHT from 320x240 to 3840x2160 (got '100x100')."),
        (("--size", "-480x320"), "--size must be WIDTHxHEIGHT"),
        (("--out", "film.png"), "--out must end in .gif (got 'film.png')."),
        (("--policy", "rond_robin"), "rond_robin"),
        (("--difficulty", "blnd"), "No difficulty 'blnd'; did you mean 'blind'?"),
    ],
)
def test_bad_input_gets_one_sentence_and_leaves_nothing(
    thermofleet, small_toml, tmp_path, monkeypatch, options, sentence
):
    monkeypatch.chdir(tmp_path)
    said = thermofleet("animate", small_toml, *QUICK, *options)
    assert said.code == 2
    assert said.err.startswith("Error: ")
    assert sentence in said.err
    assert said.err.count("\n") == 1
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["heat.toml"]


def test_too_many_frames_are_refused_before_the_work(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.prepare.fleet.prepare", None)
    options = ("--every", 1, "--out", tmp_path / "film.gif", "--size", "3840x2160", "--seconds", 1)
    long = small_toml.read_text("utf-8").replace("horizon_s = 180", "horizon_s = 7200")
    small_toml.write_text(long, encoding="utf-8")
    said = thermofleet("animate", small_toml, "--difficulty", "blind", *options)
    assert said.code == 2
    # 50 frames of 0.02 s: the first, and 49 for 720 decisions.
    assert "--every must be 15 or more for 720 decisions in 1 s of 3840x2160 px (got 1)." in said.err


def test_a_long_shift_gets_about_as_many_frames_as_a_film_has(thermofleet, small_toml, tmp_path):
    long = small_toml.read_text("utf-8").replace("horizon_s = 180", "horizon_s = 3610")
    small_toml.write_text(long.replace("every_s = 30", "every_s = 300"), encoding="utf-8")
    out = tmp_path / "film.gif"
    assert thermofleet("animate", small_toml, *QUICK, "--out", out).code == 0
    frames, _ = read(out)
    assert FRAMES / 2 < len(frames) <= FRAMES + 2
    assert out.stat().st_size < 2e6


def test_ctrl_c_leaves_nothing(thermofleet, small_toml, tmp_path, press_ctrl_c):
    with press_ctrl_c():
        said = thermofleet("animate", small_toml, *QUICK, "--out", tmp_path / "film.gif")
    assert said.code == 130
    assert said.err.startswith("Interrupted while working: nothing was written.")
    assert [path.name for path in tmp_path.iterdir()] == ["heat.toml"]


@pytest.mark.parametrize("name", library())
def test_every_scenario_of_the_library_has_a_cell(name):
    scenario = load(name)
    cell = cell_of(scenario)
    assert cell.arms == tuple(arm.name for arm in scenario.arms)
    assert cell.mounts_m == tuple(arm.position_m for arm in scenario.arms)
    assert dict(cell.stations) == {place.name: place.position_m for place in scenario.places}
    assert cell.kinds == tuple(mount_kind(arm.robot().mount) for arm in scenario.arms)


def test_the_quickstart_has_two_arms_on_the_floor_one_on_a_wall_and_one_below_the_ceiling():
    assert cell_of(load("quickstart")).kinds == ("floor", "floor", "wall", "wall")
