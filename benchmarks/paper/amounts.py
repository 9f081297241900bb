"""How much of its own logs an arm needs before an identified network predicts its heat better than a nominal one:
`amounts`.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.paper.harness import Experiment, Unit, mean_by_group, one_row, table_of, whole
from benchmarks.paper.subjects import make_study
from fleet.heat.thermal import NODES
from fleet.seeding import child
from scenarios.json_rows import Row
from scenarios.prepare.calibrate import AIR_SD_K, own_logs
from scenarios.table import Table
from twin.thermal.identify import identify
from twin.thermal.thermal_twin import RcTwin

Array = np.ndarray

MINUTES = (5.0, 10.0, 30.0, 60.0, 120.0, 240.0)
"""Length of the logs. A log has 20 min of light work and 10 min of rest; shorter ones are its begin."""
LOG_MINUTES = 30.0
JOBS = 60


def arm_row(arm: int) -> Row:
    """Absolute errors of the predicted peak of the hottest motor in half an hour of random jobs, K.

    Returns:
        By length of the logs in minutes, 0 for the nominal network: mean over the jobs that end between 40 and 80 °C.
    """
    logs_needed = int(max(MINUTES) / LOG_MINUTES)
    seed = np.random.SeedSequence(arm)
    study = make_study(seed, train=logs_needed, reference=0, test=JOBS, novel=0)
    rng = np.random.default_rng(child(seed, 9))
    logs = own_logs(study.hardware, study.train.plans, rng, ambient_c=study.ambient_c)
    true_c = study.test.peak_c.max(axis=1)
    relevant = (true_c > 40.0) & (true_c < 80.0)

    def error_k(twin: RcTwin) -> float:
        start_c = np.full(NODES, study.ambient_c)
        peak_c = twin.peaks(study.test.plans, study.test.repetitions, start_c=start_c).max(axis=1)
        return float(np.abs(peak_c - true_c)[relevant].mean())

    errors = {"0": error_k(RcTwin.nominal(ambient_c=study.ambient_c))}
    for minutes in MINUTES:
        count = max(round(minutes / LOG_MINUTES), 1)
        some = [log.part(log.time_s <= 60.0 * minutes) for log in logs[:count]]
        found = identify(some, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K)
        errors[f"{minutes:g}"] = error_k(RcTwin.of(found))
    return {"error_k": errors}


def amount_tables(rows: Sequence[Row]) -> Mapping[str, Table]:
    """Mean error over arms by the length of the logs, and its difference to the nominal network."""
    lines: list[tuple[str, ...]] = []
    for minutes in rows[0]["error_k"]:
        errors = [(str(i), row["error_k"][minutes]) for i, row in enumerate(rows)]
        gains = [(str(i), row["error_k"][minutes] - row["error_k"]["0"]) for i, row in enumerate(rows)]
        better = sum(gain < 0 for _, gain in gains)
        name = "none: nominal network" if minutes == "0" else f"{minutes} min"
        rest = () if minutes == "0" else (mean_by_group(gains).text(), f"{better} of {len(rows)}")
        lines.append((name, mean_by_group(errors, least=0.0).text(), *(rest or ("", ""))))
    heads = ("own logs", "error of the peak, K", "less the nominal network's", "arms with a smaller error")
    return {"amounts": table_of(heads, lines)}


def amount_options(parser: ArgumentParser) -> None:
    """Options of `amounts`."""
    parser.add_argument("--arms", type=whole(2), default=12, help="number of arms [12]")


def amount_units(given: Namespace) -> list[Unit]:
    """A unit for each arm."""
    return [one_row(f"{arm}", partial(arm_row, arm)) for arm in range(given.arms)]


AMOUNTS = Experiment(
    help="Identify simulated arms that differ from a nominal Gen3 from more and more of their logs.\n\nTen minutes.",
    options=amount_options,
    units=amount_units,
    tables=amount_tables,
)
