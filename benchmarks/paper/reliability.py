"""P(saturation) at the awards of shifts of the suite, compared with the outcomes, also where something is not as the
arms assume: `surprises`."""

from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import get_args

import numpy as np
from sklearn.metrics import roc_auc_score

from agents.policy import WAIT
from benchmarks.paper.harness import (
    Experiment,
    Unit,
    matching,
    mean_share,
    names,
    table_of,
    whole,
)
from fleet.difficulty import SETTLING_S
from fleet.engine.shift import StepRecord
from fleet.events import Event
from fleet.files import cache_folder
from fleet.heat.thermal import WINDING
from scenarios.evaluate.sources import Fleets, check_source
from scenarios.json_rows import Row
from scenarios.policy_loader import policy_at
from scenarios.prepare.fleet import Fleet, env_of, let_plan
from scenarios.spec.options import RISK
from scenarios.suite.instances import Surprising
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


def awards_of_shift(fleet: Fleet, policy: str, seed: int) -> tuple[Array, Array]:
    """P(saturation) at each award of a shift with a known outcome, and whether a motor passed the warning limit.

    The outcome is unknown if the shift ended, or the arm gave the job back.
    """
    records: list[StepRecord] = []
    env = env_of(fleet, bus="memory", keep_events=True, watch=records.append, decisions="interval")
    chooser, stated = policy_at(policy, seed), dict[tuple[str, int], float]()
    try:
        env.reset(seed=seed)
        let_plan(chooser, fleet, env, seed)
        while env.agents:
            known, tick = env.knowledge(), env.tick
            actions = chooser.act(known)
            for arm, action in actions.items():
                if WAIT < action < env.layout.actions - 1:
                    stated[arm, tick] = float(known[arm].p_saturation[int(action) - 1])
            env.step(actions)
    finally:
        env.close()
    ends_c = np.concatenate([record.end_c for record in records])[..., WINDING]  # [step, arm, joint]
    p, passed = list[float](), list[bool]()
    for arm, begin_s, end_s, faulted in _plans(env.events):
        if end_s is not None:
            own_c = ends_c[:, env.possible_agents.index(arm)]
            peak_c = _true_peak(own_c, env.world.dt_s, begin_s, end_s)
            p.append(stated[arm, round(begin_s / env.world.dt_s)])
            passed.append(faulted or peak_c >= fleet.scenario.limits.warning_c)
    return np.array(p), np.array(passed, dtype=bool)


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
        p, passed = awards_of_shift(fleets.of(one.scenario, source, RISK, folder), RULE, one.seed)
        p, passed = p.round(4), passed.astype(int)
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
    """Accuracy of P by source and kind of surprise."""
    lines: list[tuple[str, ...]] = []
    sources = dict.fromkeys(row["source"] for row in rows)
    kinds = [kind for kind in get_args(Surprising) if any(row["surprise"] == kind for row in rows)]
    for kind, source in product(kinds, sources):
        own = [row for row in matching(rows, source=source, surprise=kind) if row["p"]]
        if not own:
            continue
        p, passed = (np.concatenate([row[name] for row in own]) for name in ("p", "passed"))
        brier = mean_share(
            (cell_name(row["instance"]), float(np.square(np.subtract(row["p"], row["passed"])).mean())) for row in own
        )
        auroc = roc_auc_score(passed, p) if 0 < passed.sum() < len(passed) else np.nan
        measured = (passed.mean(), p.mean(), calibration_error(p, passed), auroc)
        shares = (*(f"{each:.3f}" for each in measured), brier.text(3))
        lines.append((kind, source, str(len(own)), str(len(p)), *shares))
    heads = ("surprise", "predictions", "instances", "awards", "passed", "mean P", "ECE", "AUROC", "Brier")
    return {"surprises": table_of(heads, lines)}


SURPRISES = Experiment(
    help="P(saturation) at awards of `bid_price` in instances of the test split where heat binds, and the outcomes.\n\n"
    "A quarter of an hour, once the twins are prepared.",
    options=surprise_options,
    units=surprise_units,
    tables=surprise_tables,
)
