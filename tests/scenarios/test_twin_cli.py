"""`thermofleet twin` from the command line: training on a scenario and on a log, scores, and errors."""

import csv
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from fleet.errors import FleetError
from scenarios.cli.twin import SHOWN_OF_LOG, doubts_of, network_of, subject_of
from scenarios.prepare.twins import LOG_INPUT
from tests.commands import call
from tests.logs import RATE_HZ, columns_of, csv_of, logged
from twin.vae.config import TwinConfig
from twin.vae.measures import TAU
from twin.vae.twin import load

TINY = ("--hidden", 8, "--epochs", 10, "--max-windows", 150, "--restarts", 1, "--allow-collapse")


def log_csv(seconds: float, *, celsius: float, load: float = 1.0, seed: int = 0, warms_k: float = 0.0) -> str:
    """`tests.logs.logged` as a plain log; joint 2 may warm."""
    log = logged("log", load=load, celsius=celsius, seed=seed, seconds=seconds)
    log.temp_c[:, 1] += warms_k * (1 - np.exp(-log.time_s / 300))
    return csv_of(log, ".6f")


@pytest.fixture(scope="session")
def logs(tmp_path_factory):
    """A folder of one cool log, and a hot log beside it."""
    where = tmp_path_factory.mktemp("logs")
    (where / "cool").mkdir()
    (where / "cool" / "monday.csv").write_text(log_csv(400, celsius=31.0), encoding="utf-8")
    (where / "hot.csv").write_text(log_csv(100, celsius=55.0, load=3.0), encoding="utf-8")
    return where


@pytest.fixture(scope="session")
def trained(logs, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained") / "twins"
    assert call("twin", "train", "--log", logs / "cool", *TINY, "--out", out) == 0
    return out


@pytest.fixture
def twins(trained, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(trained, tmp_path / "twins")


def test_a_log_becomes_a_twin_that_finds_threefold_torque_harder(thermofleet, twins, logs, tmp_path):
    card = json.loads((twins / "twins.json").read_text(encoding="utf-8"))
    assert card["status"] == "finished"
    mean_d, mean_load = {}, {}
    for name in ("cool/monday.csv", "hot.csv"):
        said = thermofleet("twin", "score", twins, "--log", logs / name, "--format", "csv").succeeded()
        rows = list(csv.DictReader(io.StringIO(said.out)))
        assert len(rows) == int((400 if "cool" in name else 100) * RATE_HZ) // 50
        assert {row["twin"] for row in rows} == {card["twins"][0]["version"]}
        assert {row["data"] for row in rows} == {card["twins"][0]["data_hash"]}
        mean_d[name] = np.mean([float(row["d_2"]) for row in rows])
        for row in rows:
            each = [float(row[f"d_{j}"]) for j in range(1, 8)]
            assert 7 * min(each) <= float(row["d"]) <= 7 * max(each)  # a sum with weights of mean 1
        mean_load[name] = np.mean([float(row["load"]) for row in rows])
    said = thermofleet("twin", "score", twins, "--log", logs / "hot.csv")
    assert f"version {card['twins'][0]['version']}" in " ".join(said.out.split())
    assert "…" not in said.out  # everything fits into 80 columns
    assert "hot.csv" not in said.out
    for name in ("cool/monday.csv", "hot.csv"):
        shutil.copy(logs / name, tmp_path)
    said = thermofleet("twin", "score", twins, "--log", tmp_path)
    assert {"monday", "hot"} <= set(said.out.split())  # of several recordings each row names its own
    assert mean_d["hot.csv"] > mean_d["cool/monday.csv"]
    assert mean_load["hot.csv"] > 2 * mean_load["cool/monday.csv"]


@pytest.mark.parametrize(
    ("step", "stage"),
    [
        ("twin.logs.reader.read_folder", "reading the log"),
        ("twin.vae.train.train", "learning the log"),
        ("scenarios.prepare.twins.save", "writing"),
    ],
)
def test_ctrl_c_while_a_twin_of_a_log_is_made_promises_nothing(thermofleet, logs, tmp_path, monkeypatch, step, stage):
    def interrupted(*_args, **_more):
        raise KeyboardInterrupt

    monkeypatch.setattr(step, interrupted)
    said = thermofleet("twin", "train", "--log", logs / "cool", *TINY, "--out", tmp_path / "twins")
    assert said.code == 130
    assert said.err.splitlines()[-1] == f"Interrupted while {stage}: nothing was written."
    assert not (tmp_path / "twins").exists()


def test_a_finished_training_is_kept_until_told_otherwise(thermofleet, logs, twins):
    before = (twins / "twins.json").read_bytes()
    again = ("twin", "train", "--log", logs / "cool", *TINY, "--out", twins, "--seed", 1)
    assert thermofleet(*again).code == 2
    assert (twins / "twins.json").read_bytes() == before
    thermofleet(*again, "--overwrite").succeeded()
    assert (twins / "twins.json").read_bytes() != before


@pytest.mark.ci_slow
def test_the_twin_of_one_arm_of_a_scenario_scores_its_jobs(thermofleet, small_toml, tmp_path):
    out = tmp_path / "twins"
    thermofleet("twin", "train", small_toml, "--arm", "right", *TINY, "--out", out).succeeded()
    assert [home.name for home in out.glob("*.twin")] == ["right.twin"]
    said = thermofleet("twin", "score", out, small_toml, "--json")
    rows = json.loads(said.out)["rows"]
    assert {row["job"] for row in rows} == {"hold bench", "sort shelf → bench"}
    assert all(0 <= row["d"] < 7 and row["why"] for row in rows)
    calibrated_on = json.loads((out / "twins.json").read_text(encoding="utf-8"))["twins"][0]["calibrated_on"]
    assert all((row["p_value"] is None) == (calibrated_on == 0) for row in rows)
    scaler = load(out / "right.twin").scaler
    torque_sq = scaler.mean[:, TAU] ** 2 + scaler.std[:, TAU] ** 2
    weight = 7 * torque_sq / torque_sq.sum()
    for row in rows:
        assert row["d"] == pytest.approx(sum(weight[j] * row[f"d_{j + 1}"] for j in range(7)))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["train"], "Give either a scenario or --log FILE_OR_FOLDER (got neither)."),
        (["train", "quickstart", "--arm", "arm_9"], "No arm 'arm_9' in quickstart; did you mean 'arm_"),
        (["train", "quickstart", "--size", "ful"], "No size 'ful'; did you mean 'full'?"),
        (["train", "--log", "HERE/nowhere.csv"], "nowhere.csv"),
        (["train", "--log", "HERE"], "holds no log; a log ends in"),
        (["train", "--log", "HERE/damaged.csv"], "damaged.csv, line 3: "),
        (["score", "HERE/nowhere", "quickstart"], "nowhere'; make one with: thermofleet twin train"),
        (["score", "HERE", "quickstart"], "holds no twin"),
        (["score", "HERE"], "Give either a scenario or --log"),
        (["score", "HERE", "quickstart", "--format", "cvs"], "No format 'cvs'; did you mean 'csv'?"),
        (["score", "HERE", "quickstart", "--alpha", "0.1"], "--alpha, --reading and --map are for --verdict: leave"),
        (["score", "HERE", "quickstart", "--format", "csv", "--json"], "--json and --format csv name two formats"),
        (
            ["generate", "quickstart", "--payload", "2"],
            "--payload is for --posture; the scenario's jobs have their own",
        ),
        (
            ["generate", "quickstart", "--posture", "raised", "--posture", "raised"],
            "different postures (got raised; rai",
        ),
        (["report", "quickstart", "--arm", "arm_9"], "No arm 'arm_9' in quickstart"),
        (["identify", "--log", "HERE/nowhere"], "nowhere"),
        (["recover", "quickstart", "--posture", "raisd"], "No posture 'raisd'; did you mean 'raised'?"),
    ],
)
def test_bad_input_is_told_in_one_sentence_and_nothing_is_written(thermofleet, tmp_path, arguments, sentence):
    if "damaged" in str(arguments):
        lines = log_csv(20, celsius=30).splitlines()
        (tmp_path / "damaged.csv").write_text("\n".join([*lines[:2], "1,2,oops", *lines[3:]]) + "\n", encoding="utf-8")
    before = sorted(p.name for p in tmp_path.iterdir())
    arguments = [str(argument).replace("HERE", str(tmp_path)) for argument in arguments]
    out = () if arguments[0] == "score" else ("--out", tmp_path / "out")
    said = thermofleet("twin", *arguments, *out)
    assert said.code == 2
    assert said.err.startswith("Error: ")
    assert sentence in said.err
    assert said.err.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_a_report_of_cool_logs_alone_says_first_what_will_fail(thermofleet, logs, tmp_path, monkeypatch):
    def stop(*_args, **_more):
        raise FleetError("stop")

    monkeypatch.setattr("scenarios.show.twin_report.log_subject", stop)
    for log, count in ((logs / "cool", 1), (logs / "hot.csv", 0)):
        said = thermofleet("twin", "report", "--log", log, "--out", tmp_path / "report")
        assert said.err.count("No log reaches 40 °C on joint 2: the chapters") == count
        assert said.err.endswith("Error: stop\n")


def test_a_damaged_log_can_be_read_without_its_bad_lines(thermofleet, twins, tmp_path):
    lines = log_csv(60, celsius=30).splitlines()
    damaged = tmp_path / "damaged.csv"
    damaged.write_text("\n".join([*lines[:2], "1,2,oops", *lines[3:]]) + "\n", encoding="utf-8")
    refused = thermofleet("twin", "score", twins, "--log", damaged, "--format", "csv")
    assert "--skip-damaged" in refused.err
    said = thermofleet("twin", "score", twins, "--log", damaged, "--format", "csv", "--skip-damaged").succeeded()
    assert len(said.out.splitlines()) == 1 + 2  # the head and two windows of 25 s


def test_a_recording_shorter_than_a_window_does_not_stop_the_scores_of_its_folder(
    thermofleet, trained, tmp_path, caplog
):
    for name, seconds in (("long", 60), ("brief", 20)):
        (tmp_path / f"{name}.csv").write_text(log_csv(seconds, celsius=30.0), encoding="utf-8")
    score = ("twin", "score", trained, "--log")
    said = thermofleet(*score, tmp_path, "--format", "csv").succeeded()
    assert [row["log"] for row in csv.DictReader(io.StringIO(said.out))] == ["long", "long"]
    sentence = "'brief' has no stretch of 25 s without a gap, which one window needs."
    assert caplog.messages == [f"{sentence} It is left out."]
    (tmp_path / "long.csv").unlink()
    assert thermofleet(*score, tmp_path).refused(sentence)


def test_a_log_with_a_dead_temperature_sensor_is_scored_without_temperatures(thermofleet, trained, tmp_path):
    rows = list(csv.reader(io.StringIO(log_csv(60, celsius=30.0))))
    dead, without = tmp_path / "dead.csv", tmp_path / "without.csv"
    for number, row in enumerate(rows[1:]):
        row[-7:] = ["0.0", *(f"{30 + 0.01 * number:.2f}" for _ in range(6))]
    dead.write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
    without.write_text("\n".join(",".join(row[:-7]) for row in rows) + "\n", encoding="utf-8")
    advice = "`thermofleet twin score` needs none: give it a plain log (docs/logs.md) without any temp_c column."
    assert thermofleet("twin", "score", trained, "--log", dead).refused(advice)
    thermofleet("twin", "score", trained, "--log", without).succeeded()
    assert thermofleet("twin", "identify", "--log", without).refused("has no motor temperatures")


def test_the_help_of_training_has_the_defaults_of_twins_of_logs():
    of_scenario = TwinConfig()
    shown = {name: f"{getattr(of_scenario, name):g}; --log: {value:g}" for name, value in LOG_INPUT.items()}
    assert shown == SHOWN_OF_LOG


def test_a_log_that_teaches_nothing_is_told_with_the_options_that_mend_it(thermofleet, logs, tmp_path):
    (tmp_path / "short.csv").write_text(log_csv(20, celsius=30.0), encoding="utf-8")
    some = ("--hidden", 4, "--epochs", 1, "--max-windows", 64, "--restarts", 1, "--beta", 1000)
    short = ("twin", "train", "--log", tmp_path / "short.csv", *TINY, "--out", tmp_path / "twins")
    for words, sentence in (
        (("twin", "train", "--log", logs / "hot.csv", *TINY), "Raise the limit (--cool), or record light work."),
        (short[:-2], "the longest stretch has 20 s. Record for longer, or choose a smaller window (--window)."),
        (("twin", "train", "--log", logs / "cool", *some), "--epochs, --max-windows"),
    ):
        assert thermofleet(*words, "--out", tmp_path / "twins").refused(sentence)
        assert not (tmp_path / "twins").exists()
    thermofleet(*short, "--window", 20).succeeded()


def test_an_exported_twin_ends_in_onnx(thermofleet, twins, tmp_path):
    assert "--out must name a file that ends in .onnx" in thermofleet("twin", "export", twins, "--out", tmp_path).err
    pytest.importorskip("onnx")
    out = tmp_path / "twin.onnx"
    version = json.loads((twins / "twins.json").read_text(encoding="utf-8"))["twins"][0]["version"]
    assert version in thermofleet("twin", "export", twins, "--out", out).out
    assert version.encode() in out.read_bytes()
    assert thermofleet("twin", "export", twins, "--out", out).refused("twin.onnx' exists; give another --out")
    thermofleet("twin", "export", twins, "--out", out, "--overwrite").succeeded()


def test_an_identified_arm_is_told_whole_with_its_air_and_its_place_and_is_not_replaced(thermofleet, tmp_path):
    (tmp_path / "monday.csv").write_text(log_csv(400, celsius=31.0, warms_k=5.0), encoding="utf-8")
    identify = ("twin", "identify", "--log", tmp_path / "monday.csv", "--out", tmp_path / "rc")
    said = thermofleet(*identify).succeeded()
    assert "…" not in said.out  # also the longest name fits into 80 columns
    assert "winding_housing_k_per_w" in said.out
    assert (
        f"Ambient temperature: 22 °C, assumed; give another one with --ambient.\nWritten to {tmp_path / 'rc'}"
        in said.out
    )
    assert "Do not trust" not in said.out
    network = network_of(tmp_path / "rc")
    assert network is not None
    first, *others = network.parameters
    network = replace(network, parameters=(replace(first, value=9.0 * first.prior), *others), rms_k={"monday": (0.6,)})
    wrong = "copper_w_per_a2 of joint 1 is 9 times that of a nominal Gen3, and a residual of 0.6 K"
    assert doubts_of(network)[0].startswith(f"Do not trust this network: {wrong}")
    assert json.loads(thermofleet("twin", "identify", "--log", tmp_path / "monday.csv", "--json").out)["doubts"] == []
    before = (tmp_path / "rc" / "rc.json").read_bytes()
    assert thermofleet(*identify, "--ambient", 55, "--overwrite").refused(
        "has a motor at 30 °C, below the ambient temperature of 55 °C"
    )
    assert thermofleet(*identify, "--ambient", 25).refused(
        "rc.json' exists; give another --out, or --overwrite to replace it."
    )
    assert (tmp_path / "rc" / "rc.json").read_bytes() == before
    replaced = thermofleet(*identify, "--ambient", 25, "--overwrite")
    assert "Ambient temperature: 25 °C.\n" in replaced.out
    assert json.loads((tmp_path / "rc" / "rc.json").read_text(encoding="utf-8"))["ambient_c"] == 25.0


def test_a_forecast_follows_from_a_log_and_a_plan(thermofleet, small_toml, tmp_path):
    log, plan, page = tmp_path / "today.csv", tmp_path / "plan.csv", tmp_path / "forecast.html"
    log.write_text(log_csv(300, celsius=35.0), encoding="utf-8")
    plan.write_text(log_csv(40, celsius=30.0, seed=1), encoding="utf-8")
    said = thermofleet("twin", "forecast", "--log", log, "--plan", plan, "--repeat", 15, "--out", page).succeeded()
    assert re.search(r"After 15 repetitions, 9 min 52 s, joint \d is the hottest: [\d.]+ °C \(95 % interval", said.out)
    assert re.search(r"^60 °C +< 0\.005 ", said.out, re.MULTILINE)
    assert 'id="forecast_chart"' in page.read_text(encoding="utf-8")
    card = json.loads(thermofleet("twin", "forecast", "--log", log, "--plan", plan, "--json").out)
    assert card["now_c"][1] == pytest.approx(35.0, abs=0.1)
    assert [limit["limit_c"] for limit in card["limits"]] == [40.0, 60.0, 75.0]
    assert len(card["time_s"]) == len(card["median_c"]) == len(card["low_c"])
    assert card["run_s"] == pytest.approx(39.5)
    assert max(card["residual_k"]) < 0.5
    assert "Do not trust" not in said.out
    assert re.search(r"The plan ends \d\.\d\d rad from where it begins", said.out)
    of_job = thermofleet("twin", "forecast", "--log", log, "--plan", f"{small_toml}/hold", "--repeat", 3)
    assert "The plan ends" not in of_job.out
    assert of_job.code == 0, of_job.err
    assert re.search(r"/hold by left: hold [\d.]+ kg at bench", of_job.out), of_job.out
    for word, sentence in (
        ("quickstart/nothing", "'quickstart' has no job 'nothing'. Allowed: hold_part"),
        ("nothing", "--plan must be a file, or SCENARIO/JOB as quickstart/hold_part; there is no file 'nothing'."),
        (tmp_path / "no.csv", "no.csv'."),
    ):
        assert thermofleet("twin", "forecast", "--log", log, "--plan", word).refused(sentence)
    refused = thermofleet("twin", "forecast", "--log", log, "--plan", plan, "--out", page)
    assert "--overwrite" in refused.err


def test_one_arm_of_a_log_of_several_is_chosen_by_its_name(thermofleet, tmp_path):
    """The twin and the network of an arm are those of a log of this arm alone."""
    logs = [logged(name, seed=seed, seconds=400.0) for name, seed in (("left", 1), ("right", 2))]
    for log in logs:
        log.temp_c[:] += 0.01 * log.time_s[:, None]
    both = pa.concat_tables(pa.table({"arm": [log.name] * len(log.time_s), **columns_of(log)}) for log in logs)
    path, alone = tmp_path / "telemetry.parquet", tmp_path / "alone" / "telemetry.parquet"
    alone.parent.mkdir()
    pq.write_table(both, path)
    pq.write_table(both.filter(pc.field("arm") == "right"), alone)
    cards = {}
    for log, arm in ((path, ("--arm", "right")), (alone, ())):
        train = ("twin", "train", "--log", log, *arm, *TINY, "--out", log.parent / "twins", "--json")
        (twin,) = json.loads(thermofleet(*train).succeeded().out)["twins"]
        network = json.loads(thermofleet("twin", "identify", "--log", log, *arm, "--json").succeeded().out)
        cards[log] = twin["arm"], twin["data_hash"], network["arm"], network["data_hash"]
    assert cards[path] == cards[alone]
    assert cards[path][::2] == ("right", "right")
    for words in (("train", "--out", tmp_path / "x"), ("identify",), ("forecast", "--plan", alone)):
        for arm, sentence in (
            ((), "holds several arms: choose one with --arm (left, right)."),
            (("--arm", "rigth"), "has no arm 'rigth'; did you mean 'right'? Allowed: left, right."),
        ):
            assert thermofleet("twin", *words, "--log", path, *arm).refused(sentence)


@pytest.mark.parametrize(
    ("scenario", "given", "name"),
    [(None, None, None), (None, "left", "left"), ("quickstart", None, "arm_0"), ("quickstart", "arm_2", "arm_2")],
)
def test_the_twin_of_a_subject_is_opened_once_by_the_name_of_the_arm(monkeypatch, scenario, given, name):
    opened = []
    logged = SimpleNamespace(arm=SimpleNamespace(robot="robot"))
    monkeypatch.setattr("scenarios.prepare.twins.open_twin", lambda folder, arm: opened.append((folder, arm)) or "twin")
    monkeypatch.setattr("scenarios.motion.recover.logged_arm", lambda twin, *_: logged if twin == "twin" else None)
    monkeypatch.setattr("twin.thermal.checkpoint.load", lambda _: "network")
    robot, _, known = subject_of(scenario, given, Path("twins"), Path("network"), "0,0,0", 0.0)
    assert opened == [(Path("twins"), name)]
    assert scenario or (robot, known(None)) == ("robot", logged)
