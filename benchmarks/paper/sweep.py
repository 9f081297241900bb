"""Effect of the hyperparameters of a twin (`sweep`) and of the amount of its data (`parsimony`), on several arms.

`sweep` changes one choice of the twin at a time, and takes the paper's own choices. `parsimony` trains on more and more
jobs, beside an LSTM regressor of temperature. The twin sees cool jobs without labels. The regressor needs the
temperature that each job leads to; one is trained on the same cool jobs, one on jobs of any heat. A plant can collect
those only by overheating its arm.
"""

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal  # values of fields of TwinConfig

import msgspec
import numpy as np
import torch
from torch import nn

from benchmarks.paper.harness import (
    Experiment,
    Unit,
    content_key,
    matching,
    mean_by_group,
    mean_share,
    names,
    size_given,
    size_options,
    table_of,
    whole,
    wholes,
)
from benchmarks.paper.subjects import (
    LABELS,
    RANKING,
    SCENARIOS,
    TAU,
    Sizes,
    Study,
    Subject,
    arm_of,
    carrier_of,
    detection,
    subjects_of,
    up_to_joint,
)  # fmt: skip
from fleet.errors import FleetError, nearest
from fleet.motion import RATE_HZ, Plan
from scenarios.evaluate.statistics import Interval
from scenarios.json_rows import Row
from scenarios.prepare.twins import records
from scenarios.table import Table
from twin.vae.config import RECIPE, TwinConfig
from twin.vae.model import one_thread
from twin.vae.train import train
from twin.vae.twin import Twin
from twin.vae.window import cut_jobs, windows_of

Array = np.ndarray

BASE = replace(TwinConfig.quick(), allow_collapse=True)
"""What every row changes in one point: the size that the scenarios of the library use. A collapse is a result too."""
OURS = "ours"


@dataclass(frozen=True)
class Configuration:
    """One row of the sweep."""

    group: str
    """What is varied."""
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `BASE` with other values."""
    data: Literal["cool", "any"] = "cool"
    """Training motion: cool over the whole horizon, or any motion, as if chosen by the temperature of the moment: all
    work begins cool."""

    @property
    def config(self) -> TwinConfig:
        """The configuration; strides no longer than the window."""
        return BASE.changed(**self.changes)


SGD = {"optimizer": "sgd", "learning_rate": 0.1, "epochs": 60}
"""Three times the steps: SGD needs them."""
PAPER = {**SGD, "loss": "mean", "layers": 2, "noise": (0.0, 0.0, 0.0)}
CONFIGURATIONS: Mapping[str, Configuration] = {
    OURS: Configuration("ours", "quick: β 1, 1 s, latent 2, one layer of 16, Adam 0.005, 20 epochs"),
    "paper": Configuration("paper", "all of the paper's choices below", PAPER, data="any"),
    "paper_cool": Configuration("paper", "the same, trained on motion that is cool by the whole horizon", PAPER),
    "paper_sum": Configuration("paper", "the same with the summed loss", {**PAPER, "loss": "sum"}),
    "mean": Configuration("paper, one at a time", "mean loss", {"loss": "mean"}),
    "sgd": Configuration("paper, one at a time", "SGD 0.1, 60 epochs", SGD),
    "moment": Configuration("paper, one at a time", "cool by the temperature of the moment", data="any"),
    "layers_2": Configuration("paper, one at a time", "two LSTM layers", {"layers": 2}),
    "no_noise": Configuration("paper, one at a time", "no sensor noise", {"noise": (0.0, 0.0, 0.0)}),
    "window_0.5s": Configuration("window", "0.5 s", {"window": 6}),
    "window_2s": Configuration("window", "2 s", {"window": 25}),
    "window_4s": Configuration("window", "4 s", {"window": 50}),
    "window_8s": Configuration("window", "8 s", {"window": 100}),
    "window_4s_32": Configuration("window", "4 s, 32 hidden units", {"window": 50, "hidden": 32}),
    "hidden_8": Configuration("hidden units", "8", {"hidden": 8}),
    "hidden_32": Configuration("hidden units", "32", {"hidden": 32}),
    "hidden_64": Configuration("hidden units", "64", {"hidden": 64}),
    "beta_0.25": Configuration("β", "0.25", {"beta": 0.25}),
    "beta_4": Configuration("β", "4", {"beta": 4.0}),
    "beta_16": Configuration("β", "16", {"beta": 16.0}),
    "latent_1": Configuration("latent", "1", {"latent": 1}),
    "latent_4": Configuration("latent", "4", {"latent": 4}),
    "latent_8": Configuration("latent", "8", {"latent": 8}),
    "rate_0.001": Configuration("learning rate", "0.001", {"learning_rate": 1e-3}),
    "rate_0.01": Configuration("learning rate", "0.01", {"learning_rate": 1e-2}),
    "epochs_60": Configuration("training", "60 epochs, rate 0.003", {"epochs": 60, "learning_rate": 3e-3}),
    "untrained": Configuration("training", "untrained", {"epochs": 1, "learning_rate": 1e-9}),
    "restarts_2": Configuration("training", "two restarts", {"restarts": 2}),
    "epochs_180": Configuration("training", "180 epochs", {"epochs": 180}),
    "beta_4_long": Configuration("together", "β 4, 60 epochs", {"beta": 4.0, "epochs": 60}),
    "beta_4_latent_4": Configuration("together", "β 4, latent 4, 60 epochs", {"beta": 4.0, "latent": 4, "epochs": 60}),
    "beta_2_latent_4": Configuration("together", "β 2, latent 4, 60 epochs", {"beta": 2.0, "latent": 4, "epochs": 60}),
    "latent_4_long": Configuration("together", "latent 4, 60 epochs", {"latent": 4, "epochs": 60}),
    "large": Configuration("together", "32 units, latent 4, 60 epochs", {"hidden": 32, "latent": 4, "epochs": 60}),
    "ae": Configuration("scope", "autoencoder", {"kind": "ae"}),
}
"""By the key of their rows, the most informative first."""
HOT = ("hot_60", "hot_40", "no_band")
"""Names in a row for the peak from which a job is hot, 60 or 40 °C; `no_band` leaves out jobs of 40 to 60 °C."""


def key_of(name: str, config: TwinConfig, subject: Subject) -> str:
    """Key of a row of the sweep."""
    basis = content_key(RECIPE, msgspec.to_builtins(config), asdict(subject.sizes))
    return f"{name}/{subject.name}/{basis}"


def sweep_rows(
    subject: Subject, configurations: Mapping[str, Configuration], keys: Collection[str]
) -> Iterator[tuple[str, Row]]:
    """Train the configurations of these keys on one subject, and measure how d ranks jobs.

    Raises:
        FleetError: all jobs of the subject are critical, or none is.
        Diverged: a training ended without finite weights.
    """
    study = subject.study()
    for name, configuration in configurations.items():
        key = key_of(name, configuration.config, subject)
        if key not in keys:
            continue
        source = study if configuration.data == "cool" else subject.any_motion()
        plans = up_to_joint(source.train.plans, carrier_of(study))
        start_s = time.process_time()
        twin = train(records(plans), configuration.config, subject.entropy, arm=subject.name)
        cpu_s = round(time.process_time() - start_s, 2)
        card = {"configuration": name, "subject": subject.name, **measures(twin, study)}
        yield key, card | {"epochs": configuration.config.epochs, "cpu_s": cpu_s}


def measures(twin: Twin, study: Study) -> Row:
    """How d of the carrying joint ranks the test jobs, [label][measure], and how the training of its network went."""
    carrier, test = carrier_of(study), study.test
    peak_c = test.peak_c[:, carrier]
    d = twin.features(up_to_joint(test.plans, carrier), test.repetitions).difficulty[:, carrier]
    row: Row = {"carrier": carrier + 1}
    for label in HOT:
        limit_c = study.cool_c if label == "hot_40" else study.warning_c
        kept = (peak_c < study.cool_c) | (peak_c >= study.warning_c) if label == "no_band" else peak_c == peak_c
        found = detection(d[kept], peak_c[kept], limit_c=limit_c)
        row[label] = {measure: round(value, 4) for measure, value in found.items()}
    fit = twin.fits[carrier]
    return row | {"kl": round(fit.kl, 3), "active_units": fit.active_units}


COLUMNS: Mapping[str, tuple[str, str]] = {
    "AUROC": ("hot_60", "auroc"),
    "AUPRC": ("hot_60", "auprc"),
    "Spearman": ("hot_60", "spearman"),
    "AUROC, hot from 40 °C": ("hot_40", "auroc"),
    "AUROC, 40–60 °C left out": ("no_band", "auroc"),
}
"""Path in a row of each measure that is compared with ours."""


def sweep_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """A line for each configuration: means over the arms, and paired differences to ours."""
    by_name: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_name.setdefault(row["configuration"], {})[row["subject"]] = row
    ours = by_name.get(OURS, {})
    lines = [
        (
            configuration.group,
            configuration.label,
            *(sweep_cell(by_name[name], {} if name == OURS else ours, path) for path in COLUMNS.values()),
            *plain_cells(list(by_name[name].values())),
        )
        for name, configuration in CONFIGURATIONS.items()
        if name in by_name
    ]
    caption = "in brackets: paired difference to ours, ± the 95 % margin over the arms; * if that excludes zero"
    heads = ("group", "configuration", *COLUMNS, "active units", "KL, nat", "epochs", "CPU s", "arms")
    return {"sweep": table_of(heads, lines, caption)}


def sweep_cell(rows: Mapping[str, Row], ours: Mapping[str, Row], path: tuple[str, str]) -> str:
    """A measure of one configuration, by subject, and its paired difference to ours on the same subjects."""

    def at(row: Row) -> float:
        label, measure = path
        return float(row[label][measure])

    own = mean_by_group((arm_of(subject), at(row)) for subject, row in rows.items())
    leads = [(arm_of(subject), at(row) - at(ours[subject])) for subject, row in rows.items() if subject in ours]
    if not leads:
        return _short(own.mean) + _margin(own)
    lead = mean_by_group(leads)
    clear = "*" if abs(lead.mean) > lead.margin else ""
    sign = "−" if lead.mean < 0 else "+"
    return f"{_short(own.mean)} ({sign}{_short(abs(lead.mean))}{_margin(lead)}{clear})"


def plain_cells(rows: Sequence[Row]) -> tuple[str, ...]:
    """Active units, KL, epochs and CPU time on average, and the number of subjects."""
    numbers = [(row["active_units"], row["kl"], row["epochs"], row["cpu_s"]) for row in rows]
    units, nats, epochs, cpu_s = np.mean(numbers, axis=0)
    return f"{units:.1f}", f"{nats:.2f}", f"{epochs:.0f}", f"{cpu_s:.0f}", str(len(rows))


def _margin(mean: Interval) -> str:
    return "" if mean.note else f" ± {_short(mean.margin)}"


def _short(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")


def subject_options(parser: ArgumentParser) -> None:
    """Add the options that name subjects and numbers of jobs."""
    parser.add_argument("--scenarios", type=names, default=names(SCENARIOS), help=f"scenarios [{SCENARIOS}]")
    parser.add_argument("--arms", type=wholes, default=[0, 2], help="indices of the arms in each scenario [0,2]")
    parser.add_argument("--seeds", type=whole(1), default=1, help="number of seeds of bodies, jobs and trainings [1]")
    size_options(parser, Sizes)


def subjects_given(given: Namespace) -> list[Subject]:
    """The subjects of the options."""
    sizes, seeds = size_given(given, Sizes), range(1, given.seeds + 1)
    return subjects_of(given.scenarios, arms=given.arms, seeds=seeds, sizes=sizes)


def sweep_options(parser: ArgumentParser) -> None:
    """Options of `sweep`."""
    subject_options(parser)
    parser.add_argument("--only", type=names, help="configurations, separated by commas [all]")


def sweep_units(given: Namespace) -> list[Unit]:
    """A unit for each subject.

    Raises:
        FleetError: a configuration is unknown.
    """
    for name in given.only or ():
        if name not in CONFIGURATIONS:
            raise FleetError(f"No configuration '{name}'{nearest(name, CONFIGURATIONS)}")
    chosen = {name: CONFIGURATIONS[name] for name in given.only or CONFIGURATIONS}
    return [
        Unit(
            tuple(key_of(name, each.config, subject) for name, each in chosen.items()),
            partial(sweep_rows, subject, chosen),
        )
        for subject in subjects_given(given)
    ]


SWEEP = Experiment(
    help="Train twins in many configurations, the paper's own among them, and compare how d ranks jobs.\n\n"
    "About half a minute of one core for each arm and configuration.",
    options=sweep_options,
    units=sweep_units,
    tables=sweep_tables,
)

JOBS = (3, 5, 10, 20, 40, 80, 160)
STEPS = 120
"""Steps of the optimiser for every amount of data, as many as the quick size takes with all windows."""
TWIN, LSTM_COOL, LSTM_ANY = "twin", "LSTM, same cool jobs", "LSTM, jobs of any heat"
MODELS = (TWIN, LSTM_COOL, LSTM_ANY)
KNEE = 0.02
"""The knee is the least data whose measure is within this of that with most."""


def parsimony_key(model: str, jobs: int, subject: Subject) -> str:
    """Key of a row of parsimony."""
    basis = content_key(RECIPE, STEPS, msgspec.to_builtins(BASE), asdict(subject.sizes))
    return f"{model}/{jobs}/{subject.name}/{basis}"


def parsimony_rows(subject: Subject, keys: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Train the models and amounts of these keys on one subject.

    Raises:
        FleetError: all test jobs of the subject are critical, or none is.
    """
    study, hot = subject.study(), subject.any_motion()
    for jobs in JOBS:
        for model in MODELS:
            key = parsimony_key(model, jobs, subject)
            if key in keys:
                card = {"model": model, "jobs": jobs, "subject": subject.name}
                yield key, card | parsimony_measures(model, jobs, subject, study, hot)


def parsimony_measures(model: str, jobs: int, subject: Subject, study: Study, hot: Study) -> Row:
    """Quality of d of the carrying joint, or of its predicted rise, and the minutes of motion in training."""
    carrier = carrier_of(study)
    sample = (hot if model == LSTM_ANY else study).train
    plans, known = sample.plans[:jobs], records(sample.plans[:jobs])
    test = study.test
    if model == TWIN:
        windows = min(BASE.max_windows, len(windows_of(known, BASE)))
        config = replace(BASE, epochs=max(1, round(STEPS / -(-windows // BASE.batch))))
        twin = train(records(up_to_joint(plans, carrier)), config, subject.entropy, arm=subject.name)
        score = twin.features(up_to_joint(test.plans, carrier), test.repetitions).difficulty[:, carrier]
    else:
        times = sample.repetitions[:jobs]
        seed = int(subject.entropy.generate_state(1)[0])
        rise_k = sample.peak_c[:jobs] - study.ambient_c
        regressor = train_regressor(plans, times, rise_k, BASE, seed, steps=STEPS)
        score = regressor.predict(test.plans, test.repetitions)[:, carrier]
    found = detection(score, test.peak_c[:, carrier], limit_c=study.warning_c)
    minutes = sum(map(len, known)) / RATE_HZ / 60
    return {"minutes": round(minutes, 2), **{measure: round(found[measure], 4) for measure in RANKING}}


def knee(quality: Mapping[int, float]) -> int:
    """The least number of jobs from which on the quality stays within `KNEE` of that with most jobs."""
    wanted = quality[max(quality)] - KNEE
    short = [jobs for jobs, value in quality.items() if value < wanted]
    return min(jobs for jobs in quality if jobs > max(short, default=0))


def _mean(rows: Sequence[Row], measure: str) -> float:
    return float(np.mean([row[measure] for row in rows]))


def parsimony_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """A line for each model and number of jobs: means over the arms with 95 % intervals, and the knees."""
    lines: list[tuple[str, ...]] = []
    for model in MODELS:
        by_jobs = {jobs: some for jobs in JOBS if (some := matching(rows, model=model, jobs=jobs))}
        knees = {measure: knee({jobs: _mean(some, measure) for jobs, some in by_jobs.items()}) for measure in RANKING}
        for jobs, some in by_jobs.items():
            cells = [
                mean_share(((arm_of(row["subject"]), row[measure]) for row in some), measure=measure).text(3)
                for measure in RANKING
            ]
            reached = ", ".join(LABELS[measure] for measure in RANKING if knees[measure] == jobs)
            lines.append((model, str(jobs), f"{_mean(some, 'minutes'):.1f}", *cells, reached))
    heads = ("model", "jobs", "minutes of motion", "AUROC", "AUPRC", "Spearman", "knee of")
    return {"parsimony": table_of(heads, lines, "d of the carrying joint, or its predicted rise, by amount of data")}


def parsimony_units(given: Namespace) -> list[Unit]:
    """A unit for each subject, with the amounts that its jobs allow.

    Raises:
        FleetError: they allow none.
    """
    most = size_given(given, Sizes).train
    amounts = [jobs for jobs in JOBS if jobs <= most]
    if not amounts:
        raise FleetError(f"--train must be {JOBS[0]} or more (got {most}).")
    return [
        Unit(
            tuple(parsimony_key(model, jobs, subject) for jobs in amounts for model in MODELS),
            partial(parsimony_rows, subject),
        )
        for subject in subjects_given(given)
    ]


PARSIMONY = Experiment(
    help="Compare twins and temperature regressors trained on more and more jobs: how much data each needs.\n\n"
    "About a minute of one core for each arm.",
    options=subject_options,
    units=parsimony_units,
    tables=parsimony_tables,
)

HIDDEN = 32
LEARNING_RATE = 3e-3
"""Peak of the one-cycle schedule."""
BATCH = 128
CHUNK = 256
"""Jobs read at a time."""


class _Regressor(nn.Module):
    """Windows of torques [batch, time, joint] to rises [batch, joint], all standardised."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(joints, HIDDEN, batch_first=True)
        self.head = nn.Sequential(nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, joints))

    def forward(self, torques: torch.Tensor) -> torch.Tensor:
        return self.head(self.lstm(torques)[1][0][-1])


@dataclass(frozen=True, eq=False)
class TemperatureRegressor:
    """An LSTM that predicts temperatures from torques, supervised: the rise by a job is the mean over its windows.

    Source: T. K. La & E. Guiffo Kaigom, arXiv 2509.12739: one LSTM layer and feed-forward layers on sensed joint
    torques.
    """

    net: _Regressor
    config: TwinConfig
    """How windows are cut."""
    tau: tuple[Array, Array]
    """Mean and standard deviation of the training torques, N·m, each [joint]."""
    rise: tuple[Array, Array]
    """The same of the rises, K."""

    def predict(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        """Rise of every motor at the end of each job, K, [job, joint]."""
        parts = []
        for first in range(0, len(plans), CHUNK):
            some = slice(first, first + CHUNK)
            reading = cut_jobs(plans[some], repetitions[some], self.config)
            x = torch.from_numpy(_standardised(reading.windows[..., TAU], self.tau))
            with one_thread(), torch.inference_mode():
                z = self.net(x).numpy()
            parts.append(reading.mean(z[:, None]))
        return np.concatenate(parts) * self.rise[1] + self.rise[0]


def train_regressor(
    plans: Sequence[Plan],
    repetitions: Sequence[int],
    rise_k: Array,
    config: TwinConfig,
    seed: int,
    *,
    steps: int,
) -> TemperatureRegressor:
    """A regressor fitted on jobs with known rises, on one thread.

    Args:
        rise_k: Rise of every motor at the end of each job, K, [job, joint].
        config: How windows are cut.
        steps: Steps of Adam, each with 128 random windows.

    Raises:
        ValueError: not one row of rises for each job.
    """
    if len(rise_k) != len(plans):
        raise ValueError(f"Each job needs its rises: {len(plans)} plans, {len(rise_k)} rows.")
    reading = cut_jobs(plans, repetitions, config)
    torques = reading.windows[..., TAU]
    tau = torques.mean(axis=(0, 1)), np.maximum(torques.std(axis=(0, 1)), 1e-3)
    rise = rise_k.mean(axis=0), np.maximum(rise_k.std(axis=0), 1e-3)
    x = torch.from_numpy(_standardised(torques, tau))
    y = torch.from_numpy(_standardised(rise_k[reading.job], rise))
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = _Regressor(torques.shape[-1])
        optimizer = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=max(steps, 2))
        for _ in range(steps):
            some = torch.randint(len(x), (BATCH,))
            optimizer.zero_grad()
            nn.functional.mse_loss(net(x[some]), y[some]).backward()
            optimizer.step()
            schedule.step()
    return TemperatureRegressor(net, config, tau, rise)


def _standardised(values: Array, scale: tuple[Array, Array]) -> Array:
    return ((values - scale[0]) / scale[1]).astype(np.float32)
