"""Quality of P(saturation): on past jobs of one arm (`saturation`), and at the awards of shifts (`reliability`).

`saturation` fits the learned twin and thermal networks on labelled past jobs of one studied arm and judges them, and
their alarms, on others. `reliability` compares P and predicted peaks at each award of simulated shifts with the outcome
of the plan.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from scipy.stats import norm
from sklearn.metrics import roc_auc_score

from agents.policy import WAIT
from benchmarks.paper.harness import (
    Experiment,
    Unit,
    content_key,
    names,
    number,
    scenarios_of,
    seed_options,
    seeded,
    seeds_of,
    table_of,
    whole,
)
from benchmarks.paper.quality import QualitySize, spread
from benchmarks.paper.subjects import Study, alarm_threshold, cached_twin, raised, usual_study
from fleet.difficulty import SETTLING_S
from fleet.engine.shift import StepRecord
from fleet.events import Event
from fleet.heat.thermal import WINDING
from fleet.robot import ThermalLimits
from scenarios.evaluate.sources import drawn
from scenarios.json_rows import Row
from scenarios.policy_loader import policy_at
from scenarios.prepare.calibrate import PastJobs, past_jobs
from scenarios.prepare.fleet import Fleet, env_of, prepare
from scenarios.prepare.identify import SIMULATED_LOGS, identify_from_work
from scenarios.prepare.known_cell import let_plan
from scenarios.spec.options import RISK, RiskName
from scenarios.spec.parse import choose
from scenarios.spec.schema import Scenario
from scenarios.table import Table
from twin.baselines import EVIDENCE, fit_regression
from twin.thermal.thermal_twin import RcTwin
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray

BINS = 10
"""Default number of bins of equal mass."""


@dataclass(frozen=True, eq=False)
class Reliability:
    """Stated probabilities against outcomes, by bins of equal mass without those that ties leave empty."""

    mean_p: Array
    """Mean stated probability, [bin], ascending."""
    share: Array
    """Share of jobs with the event, [bin]."""
    count: Array
    """Jobs, int [bin]."""
    low: Array
    """Lower end of the Wilson interval of the share, [bin]."""
    high: Array
    """Upper end, [bin]."""

    @property
    def error(self) -> float:
        """Expected calibration error: mean over jobs of |share − stated probability| of their bin (Naeini et al.,
        AAAI 2015, with bins of equal mass)."""
        return float(np.average(np.abs(self.share - self.mean_p), weights=self.count))


def reliability(p: Array, event: Array, *, bins: int = BINS, confidence: float = 0.95) -> Reliability:
    """The reliability table of stated probabilities [job] against outcomes, bool [job].

    Raises:
        ValueError: no jobs, unequal lengths, or probabilities outside [0, 1].
    """
    p, event = _checked(p, event)
    if bins < 1:
        raise ValueError(f"A reliability table needs at least one bin (got {bins}).")
    edges = np.percentile(p, np.linspace(0.0, 1.0, bins + 1) * 100)  # rounds as scikit-learn does
    of_job = np.searchsorted(edges[1:-1], p)
    count = np.bincount(of_job, minlength=bins)
    filled = count > 0
    some = np.maximum(count, 1)
    share = np.bincount(of_job, weights=event, minlength=bins) / some
    mean_p = np.bincount(of_job, weights=p, minlength=bins) / some
    low, high = wilson(share[filled], count[filled], confidence)
    return Reliability(mean_p[filled], share[filled], count[filled], low, high)


def wilson(share: Array, count: Array, confidence: float = 0.95) -> tuple[Array, Array]:
    """Confidence interval of a probability from the share of `count` draws (Wilson, JASA 22, 1927), both ends."""
    z = float(norm.ppf(0.5 + 0.5 * confidence))
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return np.clip(middle - half, 0.0, 1.0), np.clip(middle + half, 0.0, 1.0)


def brier(p: Array, event: Array) -> float:
    """Mean squared distance of stated probabilities [job] from outcomes, bool [job]; 0 is perfect."""
    p, event = _checked(p, event)
    return float(np.mean(np.square(p - event)))


def _checked(p: Array, event: Array) -> tuple[Array, Array]:
    p, event = np.asarray(p, dtype=float), np.asarray(event)
    if p.ndim != 1 or p.shape != event.shape or len(p) == 0:
        raise ValueError(f"Probabilities and events must be [job], at least one (got {p.shape}, {event.shape}).")
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError("Probabilities must lie in [0, 1].")
    return p, event.astype(bool).astype(float)


MEASURES = {"auroc": "AUROC", "brier": "Brier", "ece": "ECE", "peak_error_k": "error of the peak, K"}
ALARMS = {"false_alarms": "false alarms", "false_novel": "alarms on light new motion", "caught": "jobs found"}


@dataclass(frozen=True)
class SaturationSize(QualitySize):
    """Numbers of jobs; `test` follows from those of past jobs."""

    novel: int = 200
    exploration: int = 0
    """Light motions among the training jobs."""
    labelled: int = 200
    """Past jobs that a model is fitted on; as many more set the alarm."""
    held_out: int = 800
    """Past jobs that no model is fitted on."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PastWork:
    """Past jobs of a studied arm; the natural mix is split into jobs to fit on, to set alarms, and to judge on."""

    study: Study
    seed: int
    jobs: PastJobs
    fit: Array
    """Indices of jobs, int [job], as are the following."""
    watched: Array
    held_out: Array
    novel: Array


def past_work(study: Study, *, seed: int, labelled: int, watched: int) -> PastWork:
    """Past jobs made of the study's test jobs and novel motions.

    Raises:
        ValueError: too few test jobs.
    """
    natural = len(study.test)
    if natural <= labelled + watched:
        raise ValueError(f"Past work needs more than {labelled} + {watched} test jobs (got {natural}).")
    # In one call, so that novel motions too begin as warm as natural work before them leaves the arm.
    plans = (*study.test.plans, *study.novel.plans)
    jobs = past_jobs(study.hardware, plans, np.random.default_rng([seed, 7]), limits=ThermalLimits())
    order = np.random.default_rng([seed, 8]).permutation(natural)
    fit, setting, rest = np.split(order, (labelled, labelled + watched))
    novel = np.arange(natural, len(jobs))
    return PastWork(study=study, seed=seed, jobs=jobs, fit=fit, watched=setting, held_out=rest, novel=novel)


def judged(p: Array, passed: Array, peak_error_k: float = np.nan) -> Row:
    """Quality of P of jobs, [job]; `peak_error_k` is unknown where no peak is predicted."""
    quality = {"auroc": float(roc_auc_score(passed, p)), "brier": brier(p, passed)}
    return quality | {"ece": reliability(p, passed).error, "peak_error_k": peak_error_k}


def judge_twin(work: PastWork, twin: Twin) -> tuple[dict[str, Row], dict[str, Row]]:
    """Every prediction of saturation by a regression on the features of a learned twin, and the alarm on its score."""
    jobs, (fit, rest) = work.jobs, (work.fit, work.held_out)
    packed = twin.features(jobs.plans, jobs.repetitions.tolist()).packed
    calm = [work.watched, work.held_out, work.novel]
    setting, calm_rest, calm_novel = (rows[~jobs.passed[rows]] for rows in calm)
    groups_of_alarms = (calm_rest, calm_novel, rest[jobs.passed[rest]])
    predictions, alarms = dict[str, Row](), dict[str, Row]()
    for evidence in EVIDENCE:
        past = (Features(packed[fit]), jobs.duration_s[fit], jobs.known_c[fit], jobs.passed[fit])
        risk = fit_regression(*past, evidence=evidence).risk(Features(packed), jobs.duration_s)
        predictions[evidence] = judged(risk.at(jobs.known_c)[rest], jobs.passed[rest])
        score = risk.value(jobs.known_c)  # ranks jobs also where P rounds to 0 or 1
        threshold = alarm_threshold(score[setting])
        shares = (raised(score[rows], threshold) for rows in groups_of_alarms)
        alarms[evidence] = dict(zip(ALARMS, shares, strict=True))
    return predictions, alarms


def judge_networks(work: PastWork) -> dict[str, Row]:
    """Prediction of the nominal thermal network, and of one identified from logs of some of the labelled jobs."""
    study, rng = work.study, np.random.default_rng([work.seed, 9])
    logged = [work.jobs.plans[i] for i in work.fit[:SIMULATED_LOGS]]
    arm = identify_from_work(study.hardware, logged, rng, ambient_c=study.ambient_c)
    nominal = RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c)
    return {"rc nominal": judge_network(nominal, work), "rc identified": judge_network(RcTwin.of(arm), work)}


def judge_network(twin: RcTwin, work: PastWork) -> Row:
    """Prediction of a thermal network whose P is fitted to the errors of its peaks."""
    jobs, fit, rest = work.jobs, work.fit, work.held_out
    plans, times = [jobs.plans[i] for i in fit], jobs.repetitions[fit].tolist()
    fitted = twin.with_past_jobs(plans, times, known_c=jobs.known_c[fit], peak_c=jobs.hottest_c[fit])
    forecasts = [fitted.peak(jobs.plans[i], int(jobs.repetitions[i])) for i in rest]
    p, peak_c = (
        np.array([float(getattr(each, of)(known)) for each, known in zip(forecasts, jobs.known_c[rest], strict=True)])
        for of in ("at", "value")
    )
    return judged(p, jobs.passed[rest], float(np.sqrt(np.mean((peak_c - jobs.hottest_c[rest]) ** 2))))


def saturation_rows(seed: int, size: SaturationSize, _wanted: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Every prediction and alarm."""
    draw = np.random.SeedSequence(seed)
    study = usual_study(
        draw,
        train=size.train,
        exploration=size.exploration,
        reference=size.reference,
        test=2 * size.labelled + size.held_out,
        novel=size.novel,
    )
    work = past_work(study, seed=seed, labelled=size.labelled, watched=size.labelled)
    predictions, alarms = judge_twin(work, cached_twin(study.train.records(), size.config, draw))
    yield "", {"seed": seed, "predictions": predictions | judge_networks(work), "alarms": alarms}


def saturation_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Quality of every prediction and of every alarm, over the seeds."""

    def table(kind: str, measures: Mapping[str, str], caption: str) -> Table:
        lines = [
            (name, *(spread([number(row[kind][name][measure]) for row in rows]) for measure in measures))
            for name in rows[0][kind]
        ]
        return table_of(("", *measures.values()), lines, f"{caption}; mean ± standard deviation over {len(rows)} seeds")

    return {
        "saturation": table("predictions", MEASURES, "P(saturation) of held-out past jobs"),
        "saturation_alarms": table("alarms", ALARMS, "Alarm at 5 % on P(saturation), by evidence"),
    }


SATURATION = seeded(
    "P(saturation) and its alarm, for the learned twin and for thermal networks, on past jobs of one arm.\n\n"
    "Minutes for each seed.",
    SaturationSize,
    3,
    saturation_rows,
    saturation_tables,
)

POLICIES = "wspt,wspt_cool,least_difficulty"
FIRST_SEED = 10_000
"""Seeds from this one on were not used for tuning."""
WARM_K = 5.0
"""An arm is warm if its hottest motor is at most this far below the warning limit, or above the limit."""


@dataclass(frozen=True, eq=False)
class Awards:
    """Awards with a known outcome, arrays [award]."""

    p: Array
    """P(saturation) at the award."""
    predicted_c: Array
    """Predicted peak at the award."""
    peak_c: Array
    """True peak, counted as in `fleet.difficulty.SETTLING_S`; NaN if a fault ended the plan."""
    passed: Array
    """Whether a motor passed the warning limit, bool."""
    warm: Array
    """Whether the arm was warm at the award, bool; see `WARM_K`."""
    unknown: int = 0
    """Number of awards without a known outcome: the shift ended, or the arm gave the job back."""

    def __len__(self) -> int:
        return len(self.p)

    def part(self, rows: Array) -> "Awards":
        """Some of the awards, by index or mask."""
        return Awards(*(getattr(self, field.name)[rows] for field in fields(self)[:-1]))


def groups(awards: Awards) -> dict[str, Awards]:
    """All awards, those of warm arms, and those of cool arms."""
    return {"all": awards, "warm": awards.part(awards.warm), "cool": awards.part(~awards.warm)}


def join(parts: Sequence[Awards]) -> Awards:
    """Concatenate the awards of several shifts."""
    columns = [field.name for field in fields(Awards)[:-1]]
    arrays = [np.concatenate([getattr(part, name) for part in parts]) for name in columns]
    return Awards(*arrays, unknown=sum(part.unknown for part in parts))


def verdict(awards: Awards) -> Row | None:
    """Accuracy of the predictions at these awards; None without awards.

    AUROC is unknown if all awards had the same outcome; the errors of the peak are over plans that no fault ended.
    """
    if not len(awards):
        return None
    table, error_k = reliability(awards.p, awards.passed), awards.predicted_c - awards.peak_c
    error_k = error_k[np.isfinite(error_k)]
    both, peaks = 0 < awards.passed.sum() < len(awards), len(error_k) > 0
    return {
        "awards": len(awards),
        "passed": int(awards.passed.sum()),
        "ece": table.error,
        "brier": brier(awards.p, awards.passed),
        "auroc": float(roc_auc_score(awards.passed, awards.p)) if both else np.nan,
        "peak_rms_k": float(np.sqrt(np.mean(error_k**2))) if peaks else np.nan,
        "peak_bias_k": float(error_k.mean()) if peaks else np.nan,
        "reliability": {name: values.tolist() for name, values in vars(table).items()},
    }


def reliability_rows(
    scenario: Scenario,
    seeds: Sequence[int],
    fleets: int,
    risk: RiskName,
    wanted: Mapping[str, str],
    keys: Collection[str],
) -> Iterator[tuple[str, Row]]:
    """Awards over all seeds and over several draws of the arms' deviations, of each policy.

    Args:
        fleets: Number of draws: with `spread.seed` of the scenario and the following numbers.
        wanted: Policies by their keys.
    """
    missing = {key: policy for key, policy in wanted.items() if key in keys}
    found: dict[str, list[Awards]] = {key: [] for key in missing}
    for draw in range(fleets):
        fleet = prepare(drawn(scenario, draw), risk=risk)
        for key, policy in missing.items():
            found[key] += [awards_of_shift(fleet, policy, seed) for seed in seeds]
    for key, parts in found.items():
        awards = join(parts)
        judged_groups = {name: verdict(part) for name, part in groups(awards).items()}
        card = {"scenario": scenario.name, "policy": missing[key], "risk": risk, "unknown": awards.unknown}
        yield key, card | {"groups": judged_groups}


def awards_of_shift(fleet: Fleet, policy: str, seed: int) -> Awards:
    """The awards of one shift, with the predictions at each award and the outcome of its plan."""
    records: list[StepRecord] = []
    env = env_of(fleet, bus="memory", keep_events=True, watch=records.append, decisions="interval")
    chooser, stated = policy_at(policy, seed), dict[tuple[str, int], tuple[float, float, bool]]()
    warm_c = fleet.scenario.limits.warning_c - WARM_K
    try:
        env.reset(seed=seed)
        let_plan(chooser, fleet, env, seed)
        while env.agents:
            known, tick = env.knowledge(), env.tick
            actions = chooser.act(known)
            for arm, action in actions.items():
                own = known[arm]
                if WAIT < action < env.layout.actions - 1:
                    option, warm = int(action) - 1, bool(own.temp_c.max() >= warm_c)
                    stated[arm, tick] = float(own.p_saturation[option]), float(own.peak_c[option]), warm
            env.step(actions)
    finally:
        env.close()
    ends_c = np.concatenate([record.end_c for record in records])[..., WINDING]  # [step, arm, joint]
    rows, unknown = [], 0
    for arm, begin_s, end_s, faulted in _plans(env.events):
        tick = round(begin_s / env.world.dt_s)
        if end_s is None:
            unknown += 1
            continue
        own_c = ends_c[:, env.possible_agents.index(arm)]
        peak_c = np.nan if faulted else _true_peak(own_c, env.world.dt_s, begin_s, end_s)
        rows.append((*stated[arm, tick], peak_c, faulted or peak_c >= fleet.scenario.limits.warning_c))
    p, predicted_c, warm, peak_c, passed = np.array(rows, dtype=float).reshape(-1, 5).T
    return Awards(p, predicted_c, peak_c, passed.astype(bool), warm.astype(bool), unknown)


def _plans(events: Sequence[Event]) -> Iterator[tuple[str, float, float | None, bool]]:
    """Arm, begin, end, and whether a fault ended it, of every awarded plan; the end is None if it is unknown."""
    ends = ("home", "fault", "give_back", "award")
    own: dict[str, list[Event]] = {}
    for event in sorted(events, key=lambda event: event.time_s):
        if event.kind in ends:
            own.setdefault(event.arm, []).append(event)
    for arm, log in own.items():
        for event, after in zip(log, [*log[1:], None], strict=True):
            if event.kind == "award":
                end = after if after is not None and after.kind in ("home", "fault") else None
                yield arm, event.time_s, end and end.time_s, end is not None and end.kind == "fault"


def _true_peak(ends_c: Array, dt_s: float, begin_s: float, end_s: float) -> float:
    """Hottest winding at the ends of the steps between `SETTLING_S` after the begin and the end, °C.

    Args:
        ends_c: Windings of the arm at the end of each step, [step, joint].
    """
    first = round(min(begin_s + SETTLING_S, end_s) / dt_s - 1e-9)
    last = int(np.ceil(end_s / dt_s - 1e-9))
    return float(ends_c[max(first, 1) - 1 : max(last, 1)].max())


def reliability_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Accuracy of P and peaks, a row for each policy and group of arms; and the reliability diagram of all awards."""
    lines, bins = list[tuple[str, ...]](), list[tuple[str, ...]]()
    for row in rows:
        who = f"{row['scenario']}, {row['policy']}, {row['risk']}"
        for group, v in row["groups"].items():
            if v is None:
                continue
            shown = (f"{number(v[name]):.3f}" for name in ("ece", "brier", "auroc"))
            peaks = (f"{number(v['peak_rms_k']):.2f}", f"{number(v['peak_bias_k']):+.2f}")
            unknown = str(row["unknown"]) if group == "all" else ""
            lines.append((who, group, str(v["awards"]), str(v["passed"]), unknown, *shown, *peaks))
        if row["groups"]["all"] is not None:
            table = row["groups"]["all"]["reliability"]
            for p, share, low, high, count in zip(
                *(table[name] for name in ("mean_p", "share", "low", "high", "count")), strict=True
            ):
                bins.append((who, f"{p:.3f}", f"{share:.3f} [{low:.3f}, {high:.3f}]", str(count)))
    heads = ("shift", "arms", "awards", "passed", "unknown", "ECE", "Brier", "AUROC", "peak RMS, K", "peak bias, K")
    caption = f"P(saturation) in the shift; warm: a motor within {WARM_K:g} K of the warning limit, or beyond it"
    diagram = table_of(("shift", "mean P", "share passed [95 %]", "awards"), bins, "Stated and observed")
    return {"reliability": table_of(heads, lines, caption), "reliability_diagram": diagram}


def reliability_options(parser: ArgumentParser) -> None:
    """Options of `reliability`."""
    parser.add_argument("scenario", nargs="?", default="heat_wave", help="scenario [heat_wave]")
    parser.add_argument("--policies", type=names, default=names(POLICIES), help=f"policies [{POLICIES}]")
    parser.add_argument("--risk", default=RISK, help=f"model of P, as of `thermofleet run` [{RISK}]")
    parser.add_argument("--fleets", type=whole(1), default=3, help="draws of the arms' deviations [3]")
    seed_options(parser, 4, FIRST_SEED)


def reliability_units(given: Namespace) -> list[Unit]:
    """One unit with a row for each policy."""
    (scenario,), risk = scenarios_of([given.scenario]), choose("risk", given.risk, RiskName)
    seeds = seeds_of(given)
    basis = content_key([*seeds], given.fleets, risk)
    wanted = {f"{scenario.name}/{policy}/{basis}": policy for policy in given.policies}
    return [Unit(tuple(wanted), partial(reliability_rows, scenario, seeds, given.fleets, risk, wanted))]


RELIABILITY = Experiment(
    help="P(saturation) and predicted peaks at awards, compared with the outcomes in simulated shifts.\n\n"
    "P is the probability that a motor is at or above the warning limit from two minutes after the start of a plan\n"
    "until its end, or that a fault ends it. A shift takes some seconds, training for each fleet a minute per arm.",
    options=reliability_options,
    units=reliability_units,
    tables=reliability_tables,
)
