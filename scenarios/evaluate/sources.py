"""Sources of predictions by name, from the trained twin to random numbers, and the prepared fleets of a study.

A source gives the arms of a fleet their difficulty models: difficulty, P(saturation) and predicted peak. Those besides
`twin` and `oracle` do not mix two methods: d and P of a VAE come from its reconstruction errors alone, and only thermal
networks predict peak temperatures.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from fleet.difficulty import Difficulty, DifficultyModel, difficulty_of_error
from fleet.errors import FleetError, nearest
from fleet.motion import Plan
from fleet.robot import JOINTS
from scenarios.extras import require_extra
from scenarios.prepare.arms import PlannedArm, plan_arms
from scenarios.prepare.fleet import Fleet, prepare, with_surprises
from scenarios.prepare.randomisation import Randomisation, randomisation_of
from scenarios.progress import Progress, quiet
from scenarios.spec.jobs import all_works, rehearsal_works, works_of
from scenarios.spec.options import DifficultyName, RiskName
from scenarios.spec.schema import Scenario

if TYPE_CHECKING:  # need the extra `twin`
    from twin.baselines import Evidence, LoadRegression
    from twin.vae.twin import Twin

Array = np.ndarray

PREPARED: tuple[DifficultyName, ...] = get_args(DifficultyName)
"""Sources of `scenarios.prepare.fleet.prepare`, which `run` and the environment have too."""
BELOW_ONE = 1.0 - 1e-9
MOST_FLEETS = 4
"""Prepared fleets that a process keeps; one has some 10 MB per arm."""
_UNREAD = ("name", "description", "jobs", "reward", "people", "slots", "decisions", "telemetry_interval_s", "bus")
"""Fields of a scenario that `prepare` does not read, and its jobs."""
_WEATHER = ("surprises", "horizon_s", "decision_interval_s", "ambient", "start", "limits")
"""Fields that plans and trained networks do not depend on; what does is quickly made."""


@dataclass(frozen=True, eq=False)
class PlannedFleet:
    """A scenario's arms with their plans, without predictions."""

    scenario: Scenario
    folder: Path
    """Cache."""
    progress: Progress = quiet

    @cached_property
    def blind(self) -> Fleet:
        """The fleet without predictions."""
        return prepare(self.scenario, difficulty="blind", cache=self.folder, progress=self.progress)

    @cached_property
    def arms(self) -> list[PlannedArm]:
        """The arms with their plans for all motion of the scenario, light loads included."""
        every = range(len(self.scenario.arms))
        return plan_arms(self.scenario, every, rehearsal_works(self.scenario), self.folder, self.progress)

    def learned(
        self, training: int, evidence: "Evidence", *, trained: bool = True, thermometers: bool = True
    ) -> "list[Learned]":
        """The arms' twins of a training, or the same networks before training, with P of a regression.

        Args:
            thermometers: As in `with_regressions`.
        """
        from scenarios.prepare.twins import train_twins, training_seed
        from twin.baselines import untrained_config
        from twin.vae.config import TwinConfig

        spec = self.scenario.twin
        config = TwinConfig.quick() if spec.size == "quick" else TwinConfig()
        seed = training_seed(self.scenario, training)
        config = config if trained else untrained_config(config)
        twins = train_twins(self.scenario, self.arms, self.folder, self.progress, config=config, seed=seed)
        return self.with_regressions(twins, evidence=evidence, thermometers=thermometers)

    def with_regressions(
        self,
        twins: "Sequence[Twin]",
        *,
        evidence: "Evidence" = "excess",
        jobs: int | None = None,
        thermometers: bool = True,
    ) -> "list[Learned]":
        """Every arm's twin with a regression on its past jobs, which is cached.

        A twin whose past jobs say too little about saturation gets no regression; a warning says why.

        Args:
            jobs: Past jobs of each arm; default: `scenarios.prepare.calibrate.PAST_JOBS`.
            thermometers: Whether the regression reads temperatures. Without them an arm knows of its past jobs whether
                a motor warned, and of a new one the plan and the duration.
        """
        from scenarios.prepare.calibrate import PAST_JOBS, nominal_network, past_key, simulate_past
        from scenarios.prepare.twins import CachedModel, load_or_make
        from twin.baselines import LoadRegression, fit_regression, load_regression, save_regression
        from twin.thermal.thermal_twin import NotEnoughExperience

        scenario, count = self.scenario, jobs or PAST_JOBS

        def load(home: Path) -> LoadRegression | None:
            return load_regression(home) if home.is_dir() else None

        def model(arm: PlannedArm, twin: "Twin") -> "CachedModel[LoadRegression | None]":
            heat = nominal_network(scenario, arm)

            def make(home: Path, _report: Callable[[float], None]) -> str | None:
                past = simulate_past(scenario, arm, heat.heat_model, jobs=count)
                features = twin.features(past.plans, past.repetitions.tolist())
                known_c = past.known_c if thermometers else np.zeros_like(past.known_c)  # constants get no slope
                try:
                    fitted = fit_regression(features, past.duration_s, known_c, past.passed, evidence=evidence)
                except NotEnoughExperience as error:
                    name = arm.hardware.robot.name
                    return f"{scenario.name}: arm '{name}' gets no probability of saturation. {error}"
                save_regression(fitted, home)
                return None

            read = evidence if thermometers else f"{evidence}-alone"
            key = past_key(scenario, arm, f"{read}-{twin.version}-{heat.version}", count)
            return CachedModel(self.folder / "saturation" / key, load, make)

        models = [model(arm, twin) for arm, twin in zip(self.arms, twins, strict=True)]
        fitted = load_or_make(models, "calibrating", self.progress)
        return [Learned(twin, regression) for twin, regression in zip(twins, fitted, strict=True)]

    def scored(self, models: Sequence[DifficultyModel]) -> Fleet:
        """The fleet with these difficulty models."""
        arms = [replace(arm, model=model) for arm, model in zip(self.blind.arms, models, strict=True)]
        return replace(self.blind, arms=tuple(arms))


@dataclass(frozen=True)
class Learned:
    """The difficulty of a twin, and P(saturation) from a regression on its features; no predicted peak."""

    twin: "Twin"
    regression: "LoadRegression | None"
    """None: the past jobs say too little about saturation, so P is unknown."""

    @property
    def version(self) -> str:
        """Versions of the models of difficulty and P."""
        p = "" if self.regression is None else f"+p:{self.regression.evidence}-{self.regression.version}"
        return f"d:{self.twin.version}{p}"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty and P of the repeated plan."""
        features, duration_s = self.twin.features([plan], [repetitions]), np.array([plan.duration_s(repetitions)])
        risk = None if self.regression is None else self.regression.risk(features, duration_s)[0]
        return Difficulty(features.difficulty[0], risk=risk, weight=self.twin.joint_weight)


@dataclass(frozen=True)
class _Unweighted:
    """The predictions of a model with d = Σ_k d_k, as in the paper."""

    model: DifficultyModel

    @property
    def version(self) -> str:
        return f"{self.model.version}, unweighted"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        score = self.model.score(plan, repetitions)
        return score and replace(score, weight=None)


@dataclass(frozen=True)
class _Torque:
    """d_k from the RMS torque over that of the training motion, d their sum; P from a regression on squared torque."""

    known_nm: Array
    """RMS torque of the training motion, [joint]."""
    risk: DifficultyModel
    version: str = "torque, unweighted"

    def score(self, plan: Plan, repetitions: int) -> Difficulty | None:
        from twin.baselines import torque_ratio

        per_joint = difficulty_of_error(torque_ratio(plan, repetitions, self.known_nm))
        score = self.risk.score(plan, repetitions)
        return Difficulty(np.minimum(per_joint, BELOW_ONE), risk=score and score.risk)


@dataclass(frozen=True)
class _Random:
    """Uniform d_k and P for each plan and number of repetitions, the same whenever they are asked for."""

    seed: int
    version: str = "random"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        q = plan.cycle.profile[:, 0]
        motion = np.round(1e4 * q[[0, len(q) // 3, 2 * len(q) // 3, -1]])  # the same on processors that round otherwise
        digest = hashlib.sha256(motion.astype(np.int64).tobytes()).digest()
        entropy = [self.seed, repetitions, len(q), int.from_bytes(digest[:8], "little"), *plan.arm.encode()]
        drawn = np.random.default_rng(np.random.SeedSequence(entropy)).random(JOINTS + 1)
        return Difficulty(drawn[:JOINTS], p_saturation=float(drawn[JOINTS]))


def _vae(planned: PlannedFleet, training: int, *, trained: bool = True, thermometers: bool = True) -> Fleet:
    return planned.scored(planned.learned(training, "excess", trained=trained, thermometers=thermometers))


def _torque(planned: PlannedFleet, *, thermometers: bool = True) -> Fleet:
    from scenarios.prepare.twins import exploration_records, records, require_cool_plans
    from twin.baselines import known_torque

    scenario, twins = planned.scenario, planned.learned(0, "torque", thermometers=thermometers)

    def training_records(arm: PlannedArm) -> list[Array]:
        cool = require_cool_plans(arm.all_plans, arm.hardware, scenario)
        return [*records(cool), *exploration_records(scenario, arm)]

    known_nm = [known_torque(training_records(arm)) for arm in planned.arms]
    return planned.scored([_Torque(torque, twin) for torque, twin in zip(known_nm, twins, strict=True)])


def _network(planned: PlannedFleet, risk: RiskName) -> Fleet:
    from scenarios.prepare.calibrate import calibrate_networks

    heats = calibrate_networks(planned.scenario, planned.arms, planned.folder, planned.progress, risk=risk)
    fleet = planned.scored(heats)
    if risk == "rc-nominal":
        return fleet
    arms = [replace(arm, known=(heat.thermal, heat.motors)) for arm, heat in zip(fleet.arms, heats, strict=True)]
    return replace(fleet, arms=tuple(arms))


def _random(planned: PlannedFleet, training: int) -> Fleet:
    from scenarios.prepare.twins import training_seed

    return planned.scored([_Random(training_seed(planned.scenario, training))] * len(planned.arms))


SOURCES: dict[str, Callable[[PlannedFleet, int], Fleet]] = {
    # d and P of the VAE alone; `twin` has P and peak of the identified thermal network besides.
    "trained": _vae,
    "untrained": partial(_vae, trained=False),
    "unweighted": lambda planned, training: planned.scored(
        [_Unweighted(arm.model) for arm in _vae(planned, training).arms]
    ),
    # The same without thermometers: the paper's case.
    "trained-alone": partial(_vae, thermometers=False),
    "untrained-alone": partial(_vae, trained=False, thermometers=False),
    "torque-alone": lambda planned, _: _torque(planned, thermometers=False),
    # RMS torque over that of the training motion.
    "torque": lambda planned, _: _torque(planned),
    # Thermal networks alone: of a nominal arm, and as identified.
    "rc-nominal": lambda planned, _: _network(planned, "rc-nominal"),
    "rc": lambda planned, _: _network(planned, "rc"),
    "random": _random,
}
"""The fleet with the predictions of each source besides `PREPARED`, from its plans and the training, from 0."""
UNTRAINED = ("torque", "torque-alone", "rc-nominal", "rc")
"""Sources that do not depend on the training: one stands for all."""
ALL_SOURCES = (*PREPARED, *SOURCES)
"""Names, as `--difficulty` of `thermofleet compare` takes them."""


def check_source(name: str) -> None:
    """Check that there is such a source of predictions.

    Raises:
        FleetError: there is none.
    """
    if name not in ALL_SOURCES:
        raise FleetError(f"No difficulty '{name}'{nearest(name, ALL_SOURCES)}")


def is_trained(source: str) -> bool:
    """Whether a source has several trainings."""
    return source == "twin" if source in PREPARED else source not in UNTRAINED


def drawn(scenario: Scenario, fleet: int) -> Scenario:
    """The scenario with the k-th draw of its arms."""
    return replace(scenario, spread=replace(scenario.spread, seed=scenario.spread.seed + fleet))


def prepared_content(scenario: Scenario, source: str) -> tuple[object, ...]:
    """What the preparation of a fleet reads of a scenario: two with the same content have the same prepared fleet.

    Past jobs of a twin are drawn from the works and repetitions of the scenario's streams.
    """
    without_past = source in ("blind", "oracle")
    jobs = tuple((None if without_past else stream.repetitions, works_of(scenario, stream)) for stream in scenario.jobs)
    return (jobs, *(getattr(scenario, field.name) for field in fields(scenario) if field.name not in _UNREAD))


def plan_content(scenario: Scenario) -> tuple[object, ...]:
    """What takes long to make of a scenario, plans and trained twins, depends on this."""
    kept = (field.name for field in fields(scenario) if field.name not in (*_UNREAD, *_WEATHER))
    return (all_works(scenario), *(getattr(scenario, name) for name in kept))


def preparations(scenarios: Sequence[Scenario], source: str) -> list[tuple[int, int]]:
    """Numbers of the cell (`plan_content`) and of the `prepared_content` of each scenario, in order of appearance.

    Scenarios in this order find what is prepared among the last `MOST_FLEETS`.
    """
    cells: dict[object, int] = {}
    contents: dict[object, int] = {}
    return [
        (
            cells.setdefault(plan_content(each), len(cells)),
            contents.setdefault(prepared_content(each, source), len(contents)),
        )
        for each in scenarios
    ]


class Fleets:
    """Prepared fleets, the last few of them kept: one for all scenarios that share a cell."""

    def __init__(self) -> None:
        self._cells: OrderedDict[object, tuple[object, Fleet]] = OrderedDict()
        """With what the plans of each depend on."""
        self._last: tuple[object, Fleet] | None = None
        self._planned: PlannedFleet | None = None

    def of(
        self,
        scenario: Scenario,
        source: str,
        risk: RiskName,
        folder: Path,
        progress: Progress = quiet,
        *,
        training: int = 0,
        randomise: Randomisation | None = None,
    ) -> Fleet:
        """The fleet of a scenario with predictions from a source; the same object for calls that follow each other.

        Args:
            training: Of the twins, from 0.
            risk: Model of P(saturation) of the source `twin`.
            folder: Cache of plans and twins.

        Raises:
            FleetError: it cannot be prepared.
            MissingExtra: the source needs libraries that are not installed.
        """
        asked = (scenario, training, source, risk, randomise, folder)
        if self._last and self._last[0] == asked:
            return self._last[1]
        # What only the simulator knows is added to what is prepared; the true state is prepared with it.
        bare = scenario if source == "oracle" else replace(scenario, surprises=())
        cell = (prepared_content(bare, source), *asked[1:])
        if cell not in self._cells:
            plans = (plan_content(bare), source, risk, randomise, folder)
            like = next((fleet for key, fleet in self._cells.values() if key == plans), None)
            randomise_ = randomisation_of(randomise)
            made = (
                prepare(
                    bare, difficulty=source, risk=risk, randomise=randomise, training=training, cache=folder,
                    progress=progress, like=like,
                )
                if source in PREPARED
                else self._scored(bare, source, training, randomise_, folder, progress)
            )  # fmt: skip
            self._cells[cell] = plans, made
            while len(self._cells) > MOST_FLEETS:
                self._cells.popitem(last=False)
        self._cells.move_to_end(cell)
        fleet = self._cells[cell][1]
        _, *specs = (randomise or Randomisation()).scenarios_of(scenario)
        variants = [replace(each, scenario=spec) for each, spec in zip(fleet.variants, specs, strict=True)]
        found = replace(fleet, scenario=scenario, variants=tuple(variants))
        found = found if source == "oracle" else with_surprises(found)
        self._last = asked, found
        return found

    def _scored(
        self, scenario: Scenario, source: str, training: int, randomise: Randomisation, folder: Path, progress: Progress
    ) -> Fleet:
        """A fleet with its variants, and predictions from one of `SOURCES`."""
        require_extra("twin")
        fleets: list[Fleet] = []
        for spec in randomise.scenarios_of(scenario):
            last = self._planned
            if last is None or (last.scenario, last.folder) != (spec, folder):
                self._planned = last = PlannedFleet(spec, folder, progress)
            fleets.append(SOURCES[source](last, training))
        return replace(fleets[0], randomise=randomise, variants=tuple(fleets[1:]))
