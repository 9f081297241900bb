"""Sources of difficulty and P(saturation) that an ablation compares, from the trained twin to random numbers.

Each gives the arms of a fleet their difficulty models. No source uses another one: d and P of a VAE come from
its reconstruction errors alone, and only thermal networks predict peak temperatures.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from fleet.difficulty import Difficulty, DifficultyModel, difficulty_of_error, heat_weights
from fleet.motion import Plan
from fleet.robot import JOINTS
from scenarios.job_stream import rehearsal_works
from scenarios.prepare.calibrate_twins import calibrate_networks, calibrate_twins
from scenarios.prepare.cool_motion import records, require_cool_plans
from scenarios.prepare.fleet import Fleet, RiskName, prepare
from scenarios.prepare.planned_arm import PlannedArm, plan_arms
from scenarios.prepare.train_twins import exploration_records, train_twins, training_seed
from scenarios.progress import Progress
from scenarios.schema import Scenario
from twin.baselines.reconstruction import untrained_config
from twin.baselines.torque import TorqueRms, torque_over_known
from twin.thermal.calibrated import CalibratedTwin
from twin.vae.config import TwinConfig

Array = np.ndarray

BELOW_ONE = 1.0 - 1e-9


@dataclass(frozen=True, eq=False)
class DrawnFleet:
    """One draw of a scenario's arms, planned, without scores."""

    scenario: Scenario
    folder: Path
    """Cache."""
    progress: Progress

    @cached_property
    def blind(self) -> Fleet:
        """The fleet without scores."""
        return prepare(self.scenario, difficulty="blind", cache=self.folder, progress=self.progress)

    @cached_property
    def oracle(self) -> Fleet:
        """The fleet with true scores."""
        return prepare(self.scenario, difficulty="oracle", cache=self.folder, progress=self.progress)

    @cached_property
    def planned(self) -> list[PlannedArm]:
        """The arms with their plans for all motion of the scenario, light loads included."""
        arms = range(len(self.scenario.arms))
        return plan_arms(self.scenario, arms, rehearsal_works(self.scenario), self.folder, self.progress)

    def calibrated(
        self, training: int, risk: RiskName, *, trained: bool = True, changes: Mapping[str, int] | None = None
    ) -> list[CalibratedTwin]:
        """The arms' twins of a training, with P(saturation) of a kind; or the same networks before training.

        Args:
            changes: Fields of the configuration with other values.
        """
        spec = self.scenario.twin
        config = (TwinConfig.quick() if spec.size == "quick" else TwinConfig()).changed(**changes or {})
        seed = training_seed(self.scenario, training)
        twins = train_twins(
            self.scenario,
            self.planned,
            self.folder,
            self.progress,
            config=config if trained else untrained_config(config),
            seed=seed,
        )
        return calibrate_twins(self.scenario, self.planned, twins, self.folder, self.progress, risk=risk)

    def scored(self, models: Sequence[DifficultyModel]) -> Fleet:
        """The fleet with these models."""
        arms = [replace(arm, model=model) for arm, model in zip(self.blind.arms, models, strict=True)]
        return replace(self.blind, arms=tuple(arms))


@dataclass(frozen=True)
class _WithoutPeak:
    """The difficulty and P(saturation) of a model, without its predicted peak."""

    model: DifficultyModel

    @property
    def version(self) -> str:
        return f"{self.model.version}, no peak"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        score = self.model.score(plan, repetitions)
        return score and replace(score, peak=None)


@dataclass(frozen=True)
class _Unweighted:
    """The scores of a model with d = Σ_k d_k, as in the paper."""

    model: DifficultyModel

    @property
    def version(self) -> str:
        return f"{self.model.version}, unweighted"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        score = self.model.score(plan, repetitions)
        return score and replace(score, weight=None)


@dataclass(frozen=True)
class _Inverted:
    """The opposite of a model: d_k and P of hard work are those of easy work."""

    model: DifficultyModel

    @property
    def version(self) -> str:
        return f"inverted {self.model.version}"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        score = self.model.score(plan, repetitions)
        if score is None:
            return None
        assert score.risk is None or score.risk.offset.shape[-1] == 1, "the opposite of a maximum is not one"
        risk = score.risk and replace(score.risk, offset=-score.risk.offset, weight=-score.risk.weight)
        return Difficulty(np.minimum(1.0 - score.per_joint, BELOW_ONE), risk=risk, weight=score.weight)


@dataclass(frozen=True)
class _Torque:
    """d_k from the RMS torque over that of the training motion; P from a regression on the mean squared torque."""

    torque: TorqueRms
    risk: DifficultyModel
    version: str = "torque"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        per_joint = difficulty_of_error(self.torque.scores([plan], [repetitions]).per_joint[0])
        score = self.risk.score(plan, repetitions)
        weight = heat_weights(self.torque.nominal_nm**2)
        return Difficulty(np.minimum(per_joint, BELOW_ONE), risk=score and score.risk, weight=weight)


@dataclass(frozen=True)
class _Random:
    """Uniform d_k and P for each plan and number of repetitions, the same whenever they are asked for."""

    seed: int
    version: str = "random"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        motion = hashlib.sha256(np.ascontiguousarray(plan.cycle.profile).tobytes()).digest()
        entropy = [self.seed, repetitions, int.from_bytes(motion[:8], "little"), *plan.arm.encode()]
        drawn = np.random.default_rng(np.random.SeedSequence(entropy)).random(JOINTS + 1)
        return Difficulty(drawn[:JOINTS], p_saturation=float(drawn[JOINTS]))


@dataclass(frozen=True)
class _Constant:
    """The same score for everything."""

    version: str = "constant"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        return Difficulty(np.full(JOINTS, 0.5), p_saturation=0.5)


@dataclass(frozen=True)
class Source:
    """One source of scores."""

    label: str
    make: Callable[[DrawnFleet, int], Fleet]
    """The fleet with its scores, of a draw of the arms and of a training, from 0."""
    trained: bool = True
    """Whether it depends on the training; else one training stands for all."""


def _vae(drawn: DrawnFleet, training: int, *, trained: bool = True, changes: Mapping[str, int] | None = None) -> Fleet:
    models = drawn.calibrated(training, "excess", trained=trained, changes=changes)
    return drawn.scored([_WithoutPeak(model) for model in models])


def _unweighted(drawn: DrawnFleet, fleet: Fleet) -> Fleet:
    return drawn.scored([_Unweighted(arm.model) for arm in fleet.arms])


def _torque(drawn: DrawnFleet) -> Fleet:
    twins = drawn.calibrated(0, "torque")
    rules = [torque_over_known(_training_records(drawn.scenario, arm)) for arm in drawn.planned]
    return drawn.scored([_Torque(rule, twin) for rule, twin in zip(rules, twins, strict=True)])


def _training_records(scenario: Scenario, arm: PlannedArm) -> list[Array]:
    own = require_cool_plans(arm.all_plans, arm.hardware, scenario)
    return [*records(own), *exploration_records(scenario, arm)]


def _network(drawn: DrawnFleet, risk: RiskName) -> Fleet:
    heats = calibrate_networks(drawn.scenario, drawn.planned, drawn.folder, drawn.progress, risk=risk)
    fleet = drawn.scored(heats)
    if risk == "rc-nominal":
        return fleet
    arms = [replace(arm, known=(heat.thermal, heat.motors)) for arm, heat in zip(fleet.arms, heats, strict=True)]
    return replace(fleet, arms=tuple(arms))


def _random(drawn: DrawnFleet, training: int) -> Fleet:
    return drawn.scored([_Random(training_seed(drawn.scenario, training))] * len(drawn.planned))


SOURCES: dict[str, Source] = {
    "trained": Source("trained VAE", lambda drawn, training: _vae(drawn, training)),
    "untrained": Source("untrained VAE", lambda drawn, training: _vae(drawn, training, trained=False)),
    "unweighted": Source(
        "trained VAE, unweighted",
        lambda drawn, training: _unweighted(drawn, _vae(drawn, training)),
    ),
    "torque": Source("RMS torque", lambda drawn, _: _unweighted(drawn, _torque(drawn)), trained=False),
    "weighted-torque": Source("RMS torque, weighted", lambda drawn, _: _torque(drawn), trained=False),
    "rc-nominal": Source("nominal rc", lambda drawn, _: _network(drawn, "rc-nominal"), trained=False),
    "rc": Source("identified rc", lambda drawn, _: _network(drawn, "rc"), trained=False),
    "random": Source("random", _random),
    "inverted": Source(
        "inverted", lambda drawn, training: drawn.scored([_Inverted(m) for m in drawn.calibrated(training, "excess")])
    ),
    "constant": Source("constant", lambda drawn, _: drawn.scored([_Constant()] * len(drawn.planned)), trained=False),
    "blind": Source("blind", lambda drawn, _: drawn.blind, trained=False),
    "oracle": Source("oracle", lambda drawn, _: drawn.oracle, trained=False),
}
"""By name, as `--sources` takes them."""


def _variant(label: str, **changes: int) -> Source:
    return Source(f"trained VAE, {label}", lambda drawn, training: _vae(drawn, training, changes=changes))


ALL_SOURCES = SOURCES | {
    "trained-1s-16": _variant("1 s, 16 hidden units", window=12, hidden=16),
    "trained-1s-32": _variant("1 s, 32 hidden units", window=12, hidden=32),
    "trained-4s-32": _variant("4 s, 32 hidden units", window=50, hidden=32),
}
"""Besides, twins of other windows and sizes, which are compared only if named."""
