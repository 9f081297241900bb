"""What is compared of a shift: the same from the batch as from the plain kernel, which is the second method."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.policy import WAIT
from agents.rules import RULES
from fleet.bus.channel import Channel
from scenarios.build import Fleet, prepare
from scenarios.load import checked, load
from scenarios.policies import policy_of
from scenarios.replicate import FIGURES, Outcome, one_by_one, outcomes
from scenarios.run import RunSpec, run

SEEDS = (0, 3, 12)
LIBRARY = sorted(path.stem for path in (Path(__file__).parents[2] / "scenarios" / "library").glob("*.toml"))
HOT: dict[str, Any] = {
    "name": "hot",
    "description": "Three unlike arms over their limits: they fault, and are late.",
    "horizon_s": 900.0,
    "slots": 4,
    "ambient": {"points": [[0.0, 30.0], [900.0, 33.0]]},
    "limits": {"warning_c": 34.5, "error_c": 35.0, "restart_c": 34.0, "clear_s": 15.0},
    "start": "cold",
    "arms": [
        {"name": "left", "position_m": [-0.45, 0.0, 0.0]},
        {"name": "right", "position_m": [0.45, 0.0, 0.0], "tilt_deg": [0.0, 0.0, 180.0], "wear": 0.3},
        {"name": "far", "position_m": [0.0, 0.9, 0.55], "tilt_deg": [90.0, 0.0, 0.0]},
    ],
    "places": [
        {"name": "bench", "position_m": [0.0, 0.2, 0.25]},
        {"name": "shelf", "position_m": [0.0, -0.2, 0.25]},
        {"name": "rack", "position_m": [0.0, 0.0, 0.3]},
    ],
    "jobs": [
        {
            "name": "hold", "kind": "hold", "places": ["bench"], "payload_kg": [3.0, 4.0], "repetitions": [2, 4],
            "dwell_s": 15.0, "arrivals": {"kind": "poisson", "every_s": 60.0, "stop_s": 400.0}, "value": 3.0,
            "due_s": 120.0,
        },
        {
            "name": "sort", "kind": "sort", "places": ["shelf", "rack"], "payload_kg": [0.2, 0.5],
            "repetitions": [1, 3], "arrivals": {"kind": "poisson", "every_s": 40.0}, "due_s": 40.0,
        },
    ],
    "planning": {"elbows": 1, "speeds": [1.0]},
}  # fmt: skip
IN_TURN: dict[str, Any] = HOT | {
    "name": "in_turn",
    "description": "One job waits for another, and all are done before the end.",
    "limits": {},
    "jobs": [
        {
            "name": "sort", "kind": "sort", "places": ["shelf", "rack"], "payload_kg": [0.2, 0.5],
            "repetitions": [1, 3], "arrivals": {"kind": "poisson", "every_s": 40.0, "stop_s": 200.0}, "due_s": 30.0,
        },
        {
            "name": "check", "kind": "press", "places": ["rack"], "force_n": 20.0, "dwell_s": 4.0,
            "arrivals": {"kind": "batch", "count": 3, "start_s": 60.0}, "after": ["sort"], "value": 2.0,
        },
    ],
}  # fmt: skip


class Restless:
    """Remembers how often it was asked, and what it says depends on it."""

    def reset(self, rng) -> None:
        self.asked, self.rng = 0, rng

    def act(self, observations) -> dict[str, Any]:
        self.asked += 1
        arms = list(observations)[self.asked % 2 :]  # who is left out waits
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
    """Two seconds of planning each; the oracle finds every job as hard as it is."""
    if request.param == "small":
        text = (Path(__file__).parent / "conftest.py").read_text(encoding="utf-8").split('SMALL = """')[1]
        path = tmp_path_factory.mktemp("small") / "small.toml"
        path.write_text(text.split('"""')[0], encoding="utf-8")
        return prepare(load(path), difficulty="blind", cache=plans)
    given = {"hot": HOT, "in_turn": IN_TURN}[request.param]
    return prepare(checked(given, Path(f"{request.param}.toml")), difficulty="oracle", cache=plans)


@pytest.fixture(scope="module")
def hot(plans: Path) -> Fleet:
    return prepare(checked(HOT, Path("hot.toml")), difficulty="oracle", cache=plans)


def own(kind: type) -> str:
    return f"{__file__}:{kind.__name__}"


def alike(found: list[Outcome], other: list[Outcome]) -> None:
    assert len(found) == len(other)
    for one, two in zip(found, other, strict=True):
        assert asdict(one) == pytest.approx(asdict(two), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("policy", [*RULES, own(Restless)])
def test_the_batch_gives_the_figures_of_the_plain_kernel(fleet, policy) -> None:
    alike(outcomes(fleet, policy, SEEDS), one_by_one(fleet, policy, SEEDS))


def test_these_shifts_have_all_there_is_to_count(hot, plans) -> None:
    found = outcomes(hot, "round_robin", SEEDS)
    assert all(min(each.faults, each.above_warning_min, 1.0 - each.availability) > 0 for each in found)
    assert 0 < sum(each.on_time for each in found) < sum(each.finished for each in found)
    in_turn = prepare(checked(IN_TURN, Path("in_turn.toml")), difficulty="oracle", cache=plans)
    assert all(each.availability == 1 for each in outcomes(in_turn, "random", SEEDS))
    worked = run(in_turn, RunSpec(policy="random", seed=SEEDS[0], bus="memory"), record=False)
    assert worked.finished
    assert worked.time_s < in_turn.scenario.horizon_s  # all jobs are done


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_so_it_is_with_every_scenario_of_the_library(name) -> None:
    fleet = prepare(load(name), difficulty="oracle")
    for policy in RULES:
        alike(outcomes(fleet, policy, SEEDS), one_by_one(fleet, policy, SEEDS))


@pytest.mark.parametrize("policy", ["random", "round_robin", own(Restless)])
def test_a_seed_gives_the_same_whatever_the_other_seeds_are(fleet, policy) -> None:
    """To the last bit."""
    together = outcomes(fleet, policy, SEEDS)
    assert [outcomes(fleet, policy, [seed])[0] for seed in SEEDS] == together
    assert outcomes(fleet, policy, SEEDS[::-1]) == together[::-1]
    assert outcomes(fleet, policy, [0, 0]) == [together[0]] * 2
    assert len({each.reward for each in together}) > 1


def test_where_words_are_late_the_plain_kernel_steps(hot) -> None:
    late = Channel(delay_s=25.0, loss=0.3)
    found = outcomes(hot, "consensus", SEEDS, late)
    assert found == one_by_one(hot, "consensus", SEEDS, late)
    assert found != outcomes(hot, "consensus", SEEDS)


def test_a_complete_graph_by_another_name_is_no_worse(hot) -> None:
    """It is stepped by the plain kernel, to the same end."""
    star = Channel(topology="star", topology_seed=3)
    assert not star.perfect
    assert outcomes(hot, "round_robin", SEEDS, Channel(radius=0.1)) == outcomes(hot, "round_robin", SEEDS)
    alike(outcomes(hot, "round_robin", SEEDS, star), outcomes(hot, "round_robin", SEEDS))  # it asks no peer


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Stranger, r"No agent 'arm_9' in this fleet\. Agents: left, right, far\."),
        (Undecided, r"The action of 'left' must be one integer \(got 0\.5\)\."),
    ],
)
def test_what_a_policy_may_not_say_is_refused_in_the_same_words(hot, kind, said) -> None:
    for way in (outcomes, one_by_one):
        with pytest.raises(ValueError, match=said):
            way(hot, own(kind), SEEDS)


def test_the_figures_are_those_of_an_outcome_in_their_order() -> None:
    assert FIGURES == (
        "reward", "value", "finished", "on_time", "faults", "above_warning_min", "peak_c", "availability",
    )  # fmt: skip


def test_a_class_made_of_a_rule_is_asked_at_every_moment(hot, tmp_path) -> None:
    """It may remember what the rule does not."""
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
    alike(found, one_by_one(hot, f"{file}:Slow", SEEDS))
    assert replace(found[0], reward=0.0) != replace(outcomes(hot, "round_robin", SEEDS)[0], reward=0.0)
