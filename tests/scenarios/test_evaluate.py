"""The figures of a shift from the batch, against the metrics of the same shift run alone with its event log."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.policy import WAIT
from agents.registry import RULES
from fleet.bus.exchange.channel import PERFECT, Channel
from scenarios.evaluate.rollout import FIGURES, Outcome, outcomes
from scenarios.policy_loader import PolicyFailed, policy_of
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import parse_scenario

SEEDS = (0, 3, 12)
LATE = Channel(delay_s=25.0, loss=0.3)
LIBRARY = sorted(path.stem for path in (Path(__file__).parents[2] / "scenarios" / "library").glob("*.toml"))


class Restless:
    """A policy whose actions depend on how often it was asked."""

    scope = "central"

    def reset(self, rng) -> None:
        self.asked, self.rng = 0, rng

    def act(self, observations) -> dict[str, Any]:
        self.asked += 1
        arms = list(observations)[self.asked % 2 :]  # arms that are left out wait
        last = len(observations[arms[0]].action_mask) + 1
        return {arm: np.int64(self.rng.integers(-1, last)) if self.asked % 3 else WAIT for arm in arms}


class Stranger(Restless):
    def act(self, observations) -> dict[str, Any]:
        return {"arm_9": 1}


class Undecided(Restless):
    def act(self, observations) -> dict[str, Any]:
        return dict.fromkeys(observations, 0.5)


@pytest.fixture(scope="module", params=["small", "hot", "in_turn"])
def fleet(request, plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """Two seconds of planning each; difficulties are the true ones."""
    if request.param == "small":
        text = (Path(__file__).parent / "conftest.py").read_text(encoding="utf-8").split('SMALL = """')[1]
        path = tmp_path_factory.mktemp("small") / "small.toml"
        path.write_text(text.split('"""')[0], encoding="utf-8")
        return prepare(load(path), difficulty="blind", cache=plans)
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def hot(plans: Path, three_arms, job_streams) -> Fleet:
    """Three arms over their limits: they fault, and are late."""
    streams = job_streams(hold_until_s=400.0, sort_until_s=None, sort_due_s=40.0)
    given = {**three_arms, "name": "hot", "jobs": [streams["hold"], streams["sort"]]}
    return prepare(parse_scenario(given, Path("hot.toml")), difficulty="oracle", cache=plans)


@pytest.fixture(scope="module")
def in_turn(plans: Path, three_arms, job_streams) -> Fleet:
    """One job waits for another, and all finish before the end."""
    streams = job_streams(hold_until_s=0.0, sort_until_s=200.0, sort_due_s=30.0)
    given = {**three_arms, "name": "in_turn", "limits": {}, "jobs": [streams["sort"], streams["check"]]}
    return prepare(parse_scenario(given, Path("in_turn.toml")), difficulty="oracle", cache=plans)


def own(kind: type) -> str:
    return f"{__file__}:{kind.__name__}"


def one_by_one(fleet: Fleet, policy: str, seeds, channel: Channel = PERFECT) -> list[Outcome]:
    """The figures of each shift run alone, from its metrics."""
    found = []
    for seed in seeds:
        spec = RunSpec(policy=policy, seed=seed, bus="memory", channel=channel)
        result = run(fleet, spec, record=False)
        m = result.metrics
        found.append(
            Outcome(
                reward=result.reward, value=m.value, finished=m.finished, on_time=m.on_time, faults=m.faults,
                above_warning_min=m.above_warning_min, peak_c=max(m.peak_c.values()), availability=m.availability,
                insulation_ppb=max(m.insulation_ppb.values()), tool_drift_mm=max(m.tool_drift_mm.values()),
                hot_surface_min=m.hot_surface_min,
            )
        )  # fmt: skip
    return found


def check_equal(found: list[Outcome], other: list[Outcome]) -> None:
    assert len(found) == len(other)
    for one, two in zip(found, other, strict=True):
        assert asdict(one) == pytest.approx(asdict(two), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("policy", [*RULES, own(Restless)])
def test_the_batch_gives_the_figures_of_each_shift_run_alone(fleet, policy) -> None:
    check_equal(outcomes(fleet, policy, SEEDS), one_by_one(fleet, policy, SEEDS))


def test_no_figure_of_these_shifts_is_trivial(hot, in_turn) -> None:
    found = outcomes(hot, "round_robin", SEEDS)
    assert all(min(each.faults, each.above_warning_min, 1.0 - each.availability) > 0 for each in found)
    assert 0 < sum(each.on_time for each in found) < sum(each.finished for each in found)
    assert all(each.availability == 1 for each in outcomes(in_turn, "random", SEEDS))
    worked = run(in_turn, RunSpec(policy="random", seed=SEEDS[0], bus="memory"), record=False)
    assert worked.finished
    assert worked.time_s < in_turn.scenario.horizon_s  # all jobs are done


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_the_same_holds_for_every_scenario_of_the_library(name) -> None:
    fleet = prepare(load(name), difficulty="oracle")
    for policy in RULES:
        check_equal(outcomes(fleet, policy, SEEDS), one_by_one(fleet, policy, SEEDS))


@pytest.mark.parametrize("channel", [PERFECT, LATE], ids=["perfect", "late"])
@pytest.mark.parametrize("policy", ["random", "consensus", own(Restless)])
def test_a_seed_gives_the_same_whatever_the_other_seeds_are(fleet, policy, channel) -> None:
    """To the last bit; also where some shifts end before others."""
    together = outcomes(fleet, policy, SEEDS, channel)
    assert [outcomes(fleet, policy, [seed], channel)[0] for seed in SEEDS] == together
    assert outcomes(fleet, policy, SEEDS[::-1], channel) == together[::-1]
    assert outcomes(fleet, policy, [0, 0], channel) == [together[0]] * 2
    assert len({each.reward for each in together}) > 1


def test_figures_with_late_messages_are_those_of_each_shift_run_alone(fleet) -> None:
    check_equal(outcomes(fleet, "consensus", SEEDS, LATE), one_by_one(fleet, "consensus", SEEDS, LATE))


def test_late_messages_change_what_arms_agree_on(hot) -> None:
    assert outcomes(hot, "consensus", SEEDS, LATE) != outcomes(hot, "consensus", SEEDS)


def test_a_channel_does_not_matter_to_a_policy_that_reads_no_peer(hot) -> None:
    star = Channel(topology="star", topology_seed=3)
    assert not star.perfect
    expected = outcomes(hot, "round_robin", SEEDS)
    check_equal(outcomes(hot, "round_robin", SEEDS, Channel(radius=0.1)), expected)
    check_equal(outcomes(hot, "round_robin", SEEDS, star), expected)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Stranger, r"No agent 'arm_9' in this fleet\. Agents: left, right, far\."),
        (Undecided, r"The action of 'left' must be one integer \(got 0\.5\)\."),
    ],
)
def test_actions_that_cannot_be_are_refused_with_the_same_message(hot, kind, said) -> None:
    for way in (outcomes, one_by_one):
        with pytest.raises(PolicyFailed, match=said):
            way(hot, own(kind), SEEDS)


def test_the_figures_are_those_of_an_outcome_in_their_order() -> None:
    assert FIGURES == (
        "reward", "value", "finished", "on_time", "faults", "above_warning_min", "peak_c", "availability",
        "insulation_ppb", "tool_drift_mm", "hot_surface_min",
    )  # fmt: skip


def test_a_subclass_of_a_rule_is_asked_at_every_moment(hot, tmp_path) -> None:
    """It may have a memory that the rule has not."""
    file = tmp_path / "mine.py"
    file.write_text(
        "from agents.rules import RoundRobin\n"
        "class Slow(RoundRobin):\n"
        "    asked = 0\n"
        "    def act(self, seen):\n"
        "        self.asked += 1\n"
        "        return super().act(seen) if self.asked % 7 == 0 else dict.fromkeys(seen, 0)\n"
    )
    assert policy_of(f"{file}:Slow").only_choices  # pyright: ignore[reportAttributeAccessIssue]  # inherited
    found = outcomes(hot, f"{file}:Slow", SEEDS)
    check_equal(found, one_by_one(hot, f"{file}:Slow", SEEDS))
    assert replace(found[0], reward=0.0) != replace(outcomes(hot, "round_robin", SEEDS)[0], reward=0.0)
