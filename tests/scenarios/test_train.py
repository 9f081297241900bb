"""`thermofleet train`: the folder it leaves, going on, and what it refuses."""

import json

import pytest

from agents.learned.evolution import LOG
from agents.learned.policy import load_policy
from agents.learned.ppo import PpoConfig
from fleet.errors import FleetError
from scenarios.cli.main import main
from scenarios.policy_loader import label, policy_of
from scenarios.spec.load import load
from scenarios.spec.parse import override
from scenarios.train.instances import NETWORK_STATE
from scenarios.train.networks import CURVE, VALIDATION_SEED, TrainingPlan, train

SMALL = {"horizon_s": 300.0}


def small_config(**changes) -> PpoConfig:
    return PpoConfig(**{"envs": 4, "steps": 16, "epochs": 1, **changes})


def trained(out, cache, *, iterations: int = 2, resume: bool = False, **changes):
    told: list[str] = []
    plan = TrainingPlan(minutes=5.0, iterations=iterations, validate_every=1, validation_envs=2)
    scenario = override(load("quickstart"), **SMALL)
    done = train(
        scenario, small_config(**changes), out, plan, difficulty="blind", resume=resume, cache=cache, tell=told.append
    )
    return done, told


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def test_a_training_leaves_a_policy_its_log_and_its_curves(tmp_path, cache) -> None:
    out = tmp_path / "learned"
    done, told = trained(out, cache)
    assert (done.iterations, done.interrupted) == (2, False)
    assert len(told) == 3, "of iteration 0, too"
    rows = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    judged = [row["validation_reward"] for row in rows if "validation_reward" in row]
    assert done.best == max(judged)
    assert [(row["number"], row["env_steps"]) for row in rows if "number" in row] == [(1, 4 * 16), (2, 2 * 4 * 16)]
    assert (out / CURVE).read_bytes().startswith(b"\x89PNG")
    assert type(policy_of(str(out))) is type(load_policy(out))
    assert label(str(out)) == "learned"
    with pytest.raises(FleetError, match="holds a training already"):
        trained(out, cache)
    done, _ = trained(out, cache, iterations=3, resume=True)
    assert done.iterations == 3
    assert done.best >= max(judged)
    with pytest.raises(FleetError, match=r"has discount_s = 7200\.0 \(got 3600\.0\)"):
        trained(out, cache, iterations=4, resume=True, discount_s=3600.0)
    (out / NETWORK_STATE).write_bytes(b"rubbish")
    with pytest.raises(FleetError, match="the training cannot be resumed"):
        trained(out, cache, iterations=4, resume=True)


def test_validation_seeds_are_nobody_elses() -> None:
    assert VALIDATION_SEED > 1_000_000


def test_what_cannot_be_is_refused(tmp_path, capsys) -> None:
    for words, reason in (
        (["--algo", "dqn"], "No algorithm 'dqn'. Allowed: ippo, mappo, pairs."),
        (["--minutes", "0"], "minutes must be > 0"),
        (["--envs", "0"], "--envs must be 1 to 65536 (got 0)."),
        (["--threads", "0"], "--threads must be 1 to 1024 (got 0)."),
        (["--decisions", "event"], "No kind of step 'event'; did you mean 'events'? Allowed: events, interval."),
        (["--discount-hours", "0"], "--discount-hours must be 0.01 to 1000 (got 0)."),
        (["--resume"], "holds no training to resume"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["train", "quickstart", "--out", str(tmp_path / "none"), "--difficulty", "blind", *words])
        assert stop.value.code == 2
        assert reason in " ".join(capsys.readouterr().err.split())
