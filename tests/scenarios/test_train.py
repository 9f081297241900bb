"""`thermofleet train`: rewards of batches, the folder it leaves, going on, and what it refuses."""

import json
from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest

from agents.learned.config import TrainingLength
from agents.learned.evolution import CURVE, LOG, EvolutionConfig, read_log
from agents.learned.policy import load_policy
from agents.learned.ppo import PpoConfig
from agents.pairs import PAIRS_CARD, PARAMETERS, Prices
from fleet.errors import FleetError
from scenarios.evaluate.references import load_references
from scenarios.evaluate.rollout import outcomes
from scenarios.evaluate.scores import split_file
from scenarios.policy_loader import label, policy_of, scope_of
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load
from scenarios.spec.parse import override
from scenarios.suite.splits import Instance, instance
from scenarios.train import pairs, training
from scenarios.train.networks import TrainingPlan, train
from scenarios.train.pairs import PairLearner, PairPlan, rewards, train_pairs, training_instances, validation_score
from scenarios.train.training import NETWORK_STATE, PAIRS_STATE, TRAINING, holds_training

SMALL = {"horizon_s": 300.0}


def small_config(**changes) -> PpoConfig:
    return PpoConfig(**{"envs": 4, "steps": 16, "epochs": 1, **changes})


def trained(out, cache, *, iterations: int = 2, resume: bool = False, **changes):
    told: list[str] = []
    plan = TrainingPlan(minutes=100_000.0, iterations=iterations, validate_every=1, validation_envs=2)
    scenario = override(load("quickstart"), **SMALL)
    done = train(
        scenario, small_config(**changes), out, plan, difficulty="blind", resume=resume, cache=cache, tell=told.append
    )
    return done, told


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.mark.ci_slow
def test_a_training_leaves_a_policy_its_log_and_its_curves(tmp_path, cache) -> None:
    out = tmp_path / "learned"
    done, told = trained(out, cache)
    assert (done.iterations, done.interrupted) == (2, False)
    assert len(told) == 3, "of iteration 0, too"
    rows = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    judged = [row["validation"] for row in rows if "validation" in row]
    assert (done.best, done.kept) == (max(judged), judged.index(max(judged)))
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


WRONG = {
    "quickstart --out none --minutes 0": "minutes must be > 0",
    "quickstart --out none --resume": "holds no training to resume",
    "": "Give either a scenario or --suite SPLIT.",
    "quickstart --suite train": "Give either a scenario or --suite SPLIT.",
    "--suite trian": "No training split 'trian'; did you mean 'train'?",
    "test/0017": "No training split 'test'. Allowed: train.",
    "--suite train --algo mappo": "--algo needs a scenario",
    "--suite train --entropy 0.1": "--entropy needs a scenario",
    "--suite train --discount-hours 2.0": "--discount-hours needs a scenario",
    "quickstart --instances 5": "--instances needs --suite",
    "quickstart --seeds 2 --out x": "leave --out out",
    "--suite train --minutes 0": "minutes must be > 0",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_trained_is_refused(thermofleet, tmp_path, monkeypatch, words) -> None:
    monkeypatch.chdir(tmp_path)
    assert thermofleet("train", *words.split(), *(["--difficulty", "blind"] if "none" in words else [])).refused(
        WRONG[words]
    )


@pytest.fixture(scope="module")
def ground():
    scenario = override(load("quickstart"), horizon_s=600.0)
    return training_instances([Instance("train/9999", scenario, 3)])[0]


def test_rewards_of_a_batch_are_those_of_the_rule_it_begins_as(ground) -> None:
    """In the same shift, decision by decision, with perfect messages; and other parameters give another reward."""
    fleet = prepare(override(load("quickstart"), horizon_s=600.0), difficulty="oracle")
    expected = [outcome.reward for outcome in outcomes(fleet, "bid_price", [3, 4])]
    found = rewards(ground, np.zeros((2, PARAMETERS)), [3, 4])
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    refuses_all = np.zeros(PARAMETERS)
    refuses_all[Prices._fields.index("spread")] = (
        5.0  # true peaks that deviate by 740 K: each claim is as likely to fault as not
    )
    assert rewards(ground, refuses_all[None], [3])[0] < expected[0] - 1.0


def test_validation_is_the_normalised_score_of_the_shift_of_the_benchmark(ground) -> None:
    (reward,) = rewards(ground, np.zeros((1, PARAMETERS)), [ground.seed])
    some = load_references(split_file("train"))[0]
    half = replace(ground, reference=replace(some, random=reward - 5.0, hindsight=reward + 5.0))
    none = replace(ground, reference=replace(some, random=reward, hindsight=reward + 20.0))
    assert validation_score([half, none], np.zeros(PARAMETERS)) == pytest.approx(0.25)
    # Where random is as good as the hindsight, the unit is a tenth of the reward of the hindsight.
    equal = replace(ground, reference=replace(some, random=0.5 * reward, hindsight=0.5 * reward))
    assert validation_score([equal], np.zeros(PARAMETERS)) == pytest.approx(10.0)
    assert validation_score([ground], np.zeros(PARAMETERS)) == pytest.approx(reward / ground.value)
    own = replace(instance("train/0005"), name="x", seed=3)
    known = {("x", 3): replace(some, random=40.0, hindsight=60.0), ("x", 4): some}
    (made,) = training_instances([own], known=known)
    assert (made.random, made.unit) == (40.0, 20.0)


def test_a_training_leaves_a_central_policy_and_begins_with_its_teacher(tmp_path, ground) -> None:
    out, told = tmp_path / "pairs", list[str]()

    def trained(iterations: int, *, resume: bool = False, samples: int = 4, prepared: int = 1):
        plan = PairPlan(minutes=100_000.0, iterations=iterations, validate_every=1)
        config = EvolutionConfig(samples=samples)
        card: dict[str, object] = {"suite": "train", "prepared": prepared}
        return train_pairs([ground], [ground], config, out, plan, card=card, resume=resume, tell=told.append)

    done = trained(2)
    assert done.iterations == 2
    rows = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    judged = [row["validation"] for row in rows if "validation" in row]
    assert len(told) == len(judged) == 3
    teacher = rows[0]["teacher"]
    assert (done.best, done.kept) == (max(judged), judged.index(max(judged)))
    assert (out / CURVE).read_bytes().startswith(b"\x89PNG")
    assert scope_of(str(out)) == "central"
    with pytest.raises(FleetError, match="holds a training already"):
        trained(3)
    with np.load(out / PAIRS_STATE) as saved:
        assert saved["teacher"] == teacher
        assert 0.0 < saved["seconds"] <= done.seconds
        np.savez(out / PAIRS_STATE, **{**saved, "seconds": np.array(100.0)})
    with (out / LOG).open("a") as log:  # of a process that was killed, while it wrote
        log.write('{"number": 3, "fitness": 1.0}\n{"number": 4, "fit')
    again = trained(3, resume=True)
    assert [row["number"] for row in read_log(out) if "number" in row] == [1, 2, 3]
    assert again.iterations == 3
    assert again.best >= done.best
    assert again.seconds > 100.0
    with pytest.raises(FleetError, match=r"has samples = 4 \(got 6\)"):
        trained(4, resume=True, samples=6)
    with pytest.raises(FleetError, match=r"has --instances = 1 \(got 2\)"):
        trained(4, resume=True, prepared=2)
    with pytest.raises(FleetError, match="has 3 iterations: --iterations must be more"):
        trained(3, resume=True)
    (out / PAIRS_STATE).unlink()
    for resume, reason in ((False, "holds a policy without a training to resume"), (True, "holds no training to")):
        with pytest.raises(FleetError, match=reason):
            trained(4, resume=resume)


class Killed(Exception):
    pass


@pytest.mark.parametrize("calls", range(6))
def test_a_killed_training_blocks_nothing(tmp_path, ground, monkeypatch, calls) -> None:
    """After each of its first steps it either has not begun, or can be resumed."""
    out, left = tmp_path / "pairs", chain(range(calls, 0, -1), repeat(0))

    def mortal(function):
        def call(*args, **options):
            if next(left) == 0:
                raise Killed
            return function(*args, **options)

        return call

    def trained(*, resume: bool):
        plan = PairPlan(minutes=100_000.0, iterations=1)
        return train_pairs([ground], [ground], EvolutionConfig(samples=2), out, plan, card={}, resume=resume)

    with monkeypatch.context() as patch:
        for where, name in (
            (pairs, "validation_score"), (training, "_write_card"), (pairs, "save_pairs"), (PairLearner, "fitness"),
        ):  # fmt: skip
            patch.setattr(where, name, mortal(getattr(where, name)))
        with pytest.raises(Killed):
            trained(resume=False)
    assert holds_training(out) == (calls >= 3)
    with pytest.raises(FleetError, match="holds a training already" if calls >= 3 else "holds no training to resume"):
        trained(resume=calls < 3)
    assert trained(resume=calls >= 3).iterations == 1
    assert (out / PAIRS_CARD).exists()
    rows = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    assert [row["iteration"] for row in rows if "iteration" in row] == [0, 1]


def test_ctrl_c_before_the_first_state_leaves_no_training(tmp_path, cache, monkeypatch) -> None:
    out = tmp_path / "ppo"

    def interrupt(*args, **options):
        raise KeyboardInterrupt

    def trained_after(**more):
        return trained(out, cache, iterations=1, warm_start="wspt", **more)[0]

    monkeypatch.setattr("scenarios.train.networks.imitate_rule", lambda *args: None)
    with monkeypatch.context() as patch:
        patch.setattr("scenarios.train.networks.Trainer.act", interrupt)  # after the validation of the teacher
        with pytest.raises(KeyboardInterrupt):
            trained_after()
    assert not (out / TRAINING).exists()
    with pytest.raises(FleetError, match="holds no training to resume"):
        trained_after(resume=True)
    with monkeypatch.context() as patch:
        patch.setattr("scenarios.train.networks.Trainer.iterate", interrupt)
        done = trained_after()
    assert (done.iterations, done.interrupted) == (0, True)
    assert trained_after(resume=True).iterations == 1
    rows = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    judged = [row for row in rows if "validation" in row]
    assert [row["iteration"] for row in judged] == [0, 1]
    assert len({row["teacher"] for row in judged}) == 1


def test_time_of_a_session_or_in_total() -> None:
    each, total = (TrainingLength(minutes=1.0, iterations=10, in_total=in_total) for in_total in (False, True))
    assert each.share(3, 75.0, 45.0) == pytest.approx(0.5)
    assert total.share(3, 75.0, 45.0) == pytest.approx(1.25)
    assert each.share(9, 75.0, 45.0) == pytest.approx(0.9)


@pytest.mark.ci_slow
def test_an_interrupted_series_is_completed(tmp_path, ground, monkeypatch, thermofleet) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pairs, "training_instances", lambda *args, **options: [ground])
    monkeypatch.setattr("scenarios.evaluate.scores.references_of", lambda cases: {})
    words = ["--suite", "train", "--difficulty", "oracle", "--instances", "1", "--validation-instances", "1"]

    def trained(*more: str) -> tuple[list[int], int]:
        """Iterations of each training, and trainings that were skipped."""
        said = thermofleet("train", *words, *more).succeeded()
        folders = sorted((tmp_path / "runs").iterdir())
        rows = [[json.loads(line) for line in (folder / LOG).read_text().splitlines()] for folder in folders]
        skipped = " ".join(said.err.split()).count("because it is complete.")
        return [max(row["iteration"] for row in each if "iteration" in row) for each in rows], skipped

    assert trained("--iterations", "1") == ([1], 0)
    assert trained("--iterations", "2", "--seed", "1") == ([1, 2], 0)
    assert trained("--iterations", "2", "--seeds", "3", "--resume") == ([2, 2, 2], 1)
    assert trained("--minutes", "0.0001", "--seeds", "3", "--resume") == ([2, 2, 2], 3)
