"""P(saturation) and predicted peaks at the awards of simulated shifts, compared with the outcomes: `reliability` of
one scenario, and `surprises` in the suite, where something is not as the arms assume."""

from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import product

import numpy as np
from sklearn.metrics import brier_score_loss, roc_auc_score

from agents.policy import WAIT
from benchmarks.paper.harness import (
    Experiment,
    Unit,
    content_key,
    matching,
    mean_by_group,
    names,
    number,
    scenarios_of,
    seed_options,
    seeds_of,
    table_of,
    whole,
)
from fleet.difficulty import SETTLING_S
from fleet.engine.shift import StepRecord
from fleet.events import Event
from fleet.files import cache_folder
from fleet.heat.thermal import WINDING
from scenarios.evaluate.sources import Fleets, check_source, drawn
from scenarios.json_rows import Row
from scenarios.policy_loader import policy_at
from scenarios.prepare.fleet import Fleet, env_of, let_plan, prepare
from scenarios.spec.options import RISK, RiskName
from scenarios.spec.parse import choose
from scenarios.spec.schema import Scenario
from scenarios.suite.splits import cell_name, cell_of_instance, heat_binds, instance, manifest
from scenarios.table import Table

Array = np.ndarray

BINS = 10
"""Default number of bins."""


def calibration_error(p: Array, event: Array, *, bins: int = BINS) -> float:
    """Expected calibration error: mean over jobs of |share with the event − stated probability| of their bin.

    Source: Naeini et al., AAAI 2015, with bins of equal mass, without those that ties leave empty.

    Args:
        p: Stated probability, [job].
        event: Whether it happened, bool [job].

    Raises:
        ValueError: no jobs, unequal lengths, or probabilities outside [0, 1].
    """
    p, event = np.asarray(p, dtype=float), np.asarray(event)
    if p.ndim != 1 or p.shape != event.shape or len(p) == 0:
        raise ValueError(f"Probabilities and events must be [job], at least one (got {p.shape}, {event.shape}).")
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError("Probabilities must lie in [0, 1].")
    edges = np.percentile(p, np.linspace(0.0, 100.0, bins + 1))
    of_job = np.searchsorted(edges[1:-1], p)
    groups = [of_job == each for each in np.unique(of_job)]
    apart = [abs(event[group].mean() - p[group].mean()) for group in groups]
    return float(np.average(apart, weights=[group.sum() for group in groups]))


POLICIES = "wspt,wspt_cool,least_difficulty"
FIRST_SEED = 10_000
"""Seeds from this one on were not used for tuning."""


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
    unknown: int = 0
    """Number of awards without a known outcome: the shift ended, or the arm gave the job back."""

    def __len__(self) -> int:
        return len(self.p)


def join(parts: Sequence[Awards]) -> Awards:
    """Concatenate the awards of several shifts."""
    columns = [field.name for field in fields(Awards)[:-1]]
    arrays = [np.concatenate([getattr(part, name) for part in parts]) for name in columns]
    return Awards(*arrays, unknown=sum(part.unknown for part in parts))


def verdict(awards: Awards) -> Row:
    """Accuracy of the predictions at these awards.

    AUROC is unknown if all awards had the same outcome; the errors of the peak are over plans that no fault ended.

    Raises:
        ValueError: no awards.
    """
    error_k = awards.predicted_c - awards.peak_c
    error_k = error_k[np.isfinite(error_k)]
    both, peaks = 0 < awards.passed.sum() < len(awards), len(error_k) > 0
    return {
        "awards": len(awards),
        "passed": int(awards.passed.sum()),
        "ece": calibration_error(awards.p, awards.passed),
        "brier": float(brier_score_loss(awards.passed, awards.p, pos_label=True)),
        "auroc": float(roc_auc_score(awards.passed, awards.p)) if both else np.nan,
        "peak_rms_k": float(np.sqrt(np.mean(error_k**2))) if peaks else np.nan,
        "peak_bias_k": float(error_k.mean()) if peaks else np.nan,
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
        card = {"scenario": scenario.name, "policy": missing[key], "risk": risk, "unknown": awards.unknown}
        yield key, card | verdict(awards)


def awards_of_shift(fleet: Fleet, policy: str, seed: int) -> Awards:
    """The awards of one shift, with the predictions at each award and the outcome of its plan."""
    records: list[StepRecord] = []
    env = env_of(fleet, bus="memory", keep_events=True, watch=records.append, decisions="interval")
    chooser, stated = policy_at(policy, seed), dict[tuple[str, int], tuple[float, float]]()
    try:
        env.reset(seed=seed)
        let_plan(chooser, fleet, env, seed)
        while env.agents:
            known, tick = env.knowledge(), env.tick
            actions = chooser.act(known)
            for arm, action in actions.items():
                own = known[arm]
                if WAIT < action < env.layout.actions - 1:
                    option = int(action) - 1
                    stated[arm, tick] = float(own.p_saturation[option]), float(own.peak_c[option])
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
    p, predicted_c, peak_c, passed = np.array(rows, dtype=float).reshape(-1, 4).T
    return Awards(p, predicted_c, peak_c, passed.astype(bool), unknown)


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
    """Accuracy of P and peaks, a row for each policy."""
    lines: list[tuple[str, ...]] = []
    for row in rows:
        who = f"{row['scenario']}, {row['policy']}, {row['risk']}"
        counts = (str(row[name]) for name in ("awards", "passed", "unknown"))
        shown = (f"{number(row[name]):.3f}" for name in ("ece", "brier", "auroc"))
        lines.append((who, *counts, *shown, f"{number(row['peak_rms_k']):.2f}", f"{number(row['peak_bias_k']):+.2f}"))
    heads = ("shift", "awards", "passed", "unknown", "ECE", "Brier", "AUROC", "peak RMS, K", "peak bias, K")
    caption = "P(saturation) and predicted peak at each award, and the outcome"
    return {"reliability": table_of(heads, lines, caption)}


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


SOURCES = ("rc", "twin", "oracle")
MOST_ARMS = 6
RULE = "bid_price"


def surprise_rows(names_of: Mapping[str, str], source: str, keys: Collection[str]) -> Iterator[tuple[str, Row]]:
    """The awards of instances with predictions from one source.

    Args:
        names_of: Instances by their keys.
    """
    fleets, folder = Fleets(), cache_folder()
    for key in keys:
        one = instance(names_of[key])
        awards = awards_of_shift(fleets.of(one.scenario, source, RISK, folder), RULE, one.seed)
        p, passed = awards.p.round(4), awards.passed.astype(int)
        kind = _LINES[one.name].axes.surprise
        yield key, {"source": source, "instance": one.name, "surprise": kind, "p": p, "passed": passed}


_LINES = {line.name: line for line in manifest("test")}


def surprise_options(parser: ArgumentParser) -> None:
    """Options of `surprises`."""
    parser.add_argument("--sources", type=names, default=[*SOURCES], help=f"predictions [{','.join(SOURCES)}]")
    parser.add_argument("--cells", type=whole(1), help="number of cells [all]")


def surprise_units(given: Namespace) -> list[Unit]:
    """A unit for each source and cell of the test split with at most `MOST_ARMS`, where heat binds."""
    chosen = [name for name in _LINES if heat_binds(name) and cell_of_instance(_LINES[name]).arms <= MOST_ARMS]
    units: list[Unit] = []
    for source in given.sources:
        check_source(source)
    cells = [*dict.fromkeys(map(cell_name, chosen))][: given.cells]
    for cell, source in product(cells, given.sources):
        wanted = {f"{source}/{name}": name for name in chosen if cell_name(name) == cell}
        units.append(Unit(tuple(wanted), partial(surprise_rows, wanted, source)))
    return units


def surprise_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Accuracy of P by source, in instances with and without a surprise."""
    lines: list[tuple[str, ...]] = []
    sources = dict.fromkeys(row["source"] for row in rows)
    for source, surprised in product(sources, (False, True)):
        own = [row for row in matching(rows, source=source) if (row["surprise"] != "nothing") == surprised]
        own = [row for row in own if row["p"]]
        if not own:
            continue
        p, passed = (np.concatenate([row[name] for row in own]) for name in ("p", "passed"))
        brier = mean_by_group(
            (
                (cell_name(row["instance"]), float(np.square(np.subtract(row["p"], row["passed"])).mean()))
                for row in own
            ),
            least=0.0,
            most=1.0,
        )
        shares = (f"{passed.mean():.3f}", f"{p.mean():.3f}", f"{calibration_error(p, passed):.3f}", brier.text(3))
        lines.append((source, "yes" if surprised else "no", str(len(own)), str(len(p)), *shares))
    heads = ("predictions", "surprise", "instances", "awards", "passed", "mean P", "ECE", "Brier")
    return {"surprises": table_of(heads, lines)}


SURPRISES = Experiment(
    help="P(saturation) at awards of `bid_price` in instances of the test split where heat binds, and the outcomes.\n\n"
    "A quarter of an hour, once the twins are prepared.",
    options=surprise_options,
    units=surprise_units,
    tables=surprise_tables,
)
