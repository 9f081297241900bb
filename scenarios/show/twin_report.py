"""`thermofleet twin report`: the figures of the paper on one page, from simulated jobs of an arm or from its logs.

The order is that of the paper (E. Guiffo Kaigom, arXiv 2509.12740): training data, latent map, reconstruction,
difficulty, error by epochs, generated motion. RMS torque and an untrained network stand beside every result of the
twin.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any  # values of JSON and of Plotly's schema

import numpy as np
from joblib import cpu_count, delayed
from sklearn.metrics import roc_auc_score

from fleet.arm.random_motions import random_jobs
from fleet.errors import FleetError
from fleet.motion import CHANNELS, RATE_HZ
from scenarios.prepare.arms import plan_arms
from scenarios.prepare.twins import (
    LOG_INPUT,
    cold_peaks,
    exploration_records,
    records,
    require_cool_plans,
    train_or_load,
    train_twins,
    training_seed,
)
from scenarios.processes import worker_processes
from scenarios.progress import Count, Progress, quiet
from scenarios.result_folder import ResultKind, json_text
from scenarios.show.charts import AXIS, COLOURS, LAYOUT, Trace, curve
from scenarios.show.page import Chart, Head, Page, Section, origin_table
from scenarios.spec.jobs import rehearsal_works
from scenarios.spec.schema import Scenario
from scenarios.table import Table
from twin.baselines import untrained_config
from twin.log_windows import log_windows
from twin.logs.recording import Recording, cool_stretches, stretches
from twin.vae.config import TwinConfig
from twin.vae.measures import TAU, Calibration, Features
from twin.vae.train import train
from twin.vae.twin import Twin
from twin.vae.window import cut, cut_jobs, draw_windows, resample, starts, windows_of

Array = np.ndarray
Cells = dict[tuple[int, int], list[Trace]]
"""Plotly traces by row and column of a chart."""

CARD, PAGE = "report.json", "report.html"
REPORT = ResultKind(name="twin report", card=CARD, files=(CARD, PAGE))
CHANNEL_NAMES = ("position", "velocity", "torque")
CHANNEL_HEADS = ("position, rad", "velocity, rad/s", "torque, N·m")
BLUE, ORANGE, GREEN, GREY = (*COLOURS[:3], COLOURS[-1])
"""Cool or the twin, hot, untrained, other."""
LEAST_ERROR = 1e-6
"""Errors below it, in z units, count as equal."""
MOST_POINTS = 1500
"""Points of a line; a long recording is drawn with fewer samples."""
OWN_AXES_PX = 600
"""Least width of panels side by side that each have a y axis, so that no label covers another panel."""
QUANTILES = {"lowerfence": 5, "q1": 25, "median": 50, "q3": 75, "upperfence": 95}
COOL, BETWEEN, HOT = 0, 1, 2
"""Kinds of jobs and windows."""
TEST_JOBS = 5
"""Spawn key, different from those of `scenarios.prepare.twins` and `calibrate` for the same arm."""
LOADED_JOINT = 1
"""The joint whose temperature divides logs into cool and hot, index 0..6: joint 2 carries a standing arm."""
LOG_HOT_C = 40.0
"""Mean temperature of joint 2 from which a window of a log is hot; a file that never reaches it is cool."""
LOG_TRAIN_SHARE = 0.6
"""Share of the cool files that train the twin of logs."""
LOG_CONFIG = TwinConfig(record_hz=2.0, epochs=40, restarts=1).changed(**LOG_INPUT)
"""Windows of 25 s at the sampling rate of the logs."""
LIMITS = (
    "d uses motion and torque alone. It ignores the temperatures at the start and the duration of a job; a thermal "
    "network uses both. A high d means new motion or more load than usual, and only load heats.",
    "Simulated temperatures are those of a thermal network whose absolute scale is known to ± 25 %.",
)


@dataclass(frozen=True, kw_only=True)
class Size:
    """Amount of computation of a report."""

    jobs: int = 600
    """Random test jobs of an arm of a scenario."""
    windows: int = 2000
    """Most windows of each kind in a latent map."""
    epochs: tuple[int, ...] = (0, 20, 40, 60, 120, 240)
    """0 is the untrained network."""
    epoch_seeds: int = 3
    strengths: tuple[float, ...] = (0.0, 1.0, 4.0)
    """Perturbations of generated motion, in posterior standard deviations."""
    generated: int = 5
    """Motions for each strength."""


SIZE = Size()


@dataclass(frozen=True, eq=False)
class Made:
    """Motions that a network generated at one strength, and their sources."""

    pairs: tuple[tuple[Array, Array], ...]
    """Source and motion, q, qd, tau, [time, 3, joint] each."""
    rate_hz: float
    distance_rad: float
    """RMS distance of the positions from those of the source, mean over the motions; NaN without motions."""
    outcome: str
    """Result of the verification."""
    cool_share: float | None = None
    """Share of the motions whose true motors stay cool; None if it is not known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Subject:
    """One twin, and the motion on which it is judged. An item is a job of a scenario, or a window of a log."""

    twin: Twin
    untrained: Twin
    """The same network with its initial weights."""
    joint: int
    """The joint that is shown, index 0..6."""
    item: str
    """What is scored: job or window."""
    kinds: tuple[str, str, str]
    """What cool, between and hot mean."""
    how: str
    """Origin of the test data."""
    trained_on: Sequence[Array]
    """Training records, [time, 3, joint] each, at `twin.config.record_hz`."""
    kind: Array
    """COOL, BETWEEN or HOT, [item]."""
    features: Features
    """Of the items under the twin, [item, joint]."""
    untrained_features: Features
    windows: Array
    """Windows of test motion, SI, [window, time, joint, channel]."""
    window_hot: Array
    """bool [window]."""
    names: Sequence[str]
    """Whole recordings of the test motion."""
    recorded_hot: Array
    """bool [recording]."""
    recorded: Features
    """Of the recordings under the twin, [recording, joint]."""
    motion: Callable[[int], Array]
    """Motion of a recording at the rate of the twin, [time, 3, joint]."""
    cool_jobs: Sequence[Sequence[Array]]
    """Profiles of the phases of cool test items, [time, 3, joint] at `twin.config.record_hz`, for the epoch table."""
    epoch_records: int
    """Number of them that its networks learn: few, so that more epochs still help."""
    make: Callable[[Twin, float, int], Made]
    """Generate motions: network, strength, number."""

    @cached_property
    def examples(self) -> tuple[int, int]:
        """A typical cool and a typical hot recording.

        Raises:
            FleetError: a kind is missing.
        """
        groups = [np.flatnonzero(self.recorded_hot == hot) for hot in (False, True)]
        if not all(map(len, groups)):
            raise FleetError(
                f"{len(groups[1])} of {sum(map(len, groups))} recordings or jobs get hot: there is nothing to compare. "
                "Add hotter or cooler ones, or take another arm."
            )
        errors = self.recorded.errors[:, self.joint]
        cool, hot = (int(group[typical(errors[group])]) for group in groups)
        return cool, hot

    @property
    def networks(self) -> dict[str, Twin]:
        """The twin and its baseline by name."""
        return {"twin": self.twin, "untrained network": self.untrained}

    def torque_auroc(self, windows: Array, hot: Array) -> float:
        """How well the RMS torque of windows [window, time, joint, channel] tells the hot ones [window]."""
        return auroc(hot, np.square(windows[:, :, self.joint, TAU], dtype=float).mean(axis=1))

    def scores(self) -> dict[str, Array]:
        """Scores of the items, higher for harder ones, each [item]; the first is that of the paper for one joint."""
        j, of = self.joint, f"joint {self.joint + 1}"
        return {
            f"d of {of}": self.features.errors[:, j].sum(axis=-1),
            "d, weighted": self.features.difficulty @ self.twin.joint_weight,
            "Σ d (paper)": self.features.difficulty.sum(axis=1),
            f"RMS torque of {of}": self.features.torque_sq[:, j],
            f"d of {of}, untrained network": self.untrained_features.errors[:, j].sum(axis=-1),
        }


def typical(errors: Array) -> int:
    """Index of the row whose errors are nearest the median of each channel, by the ratio in the worst channel.

    A recording whose error is usual in one channel can be unusual in another, and then misrepresents its kind there.

    Args:
        errors: [row, channel], one row or more.
    """
    ratio = np.maximum(errors, LEAST_ERROR) / np.maximum(np.median(errors, axis=0), LEAST_ERROR)
    return int(np.argmin(np.abs(np.log(ratio)).max(axis=1)))


def auroc(event: Array, score: Array) -> float:
    """Area under the ROC curve, NaN if the event [item] is always true or never."""
    return float(roc_auc_score(event, score)) if event.any() and not event.all() else float("nan")


def spread(values: Sequence[float] | Array, digits: int = 3) -> str:
    """Mean and sample standard deviation over the seeds as text, `0.941 ± 0.006`; the mean alone for one seed."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return "–"
    mean = f"{finite.mean():.{digits}f}"
    return mean if len(finite) == 1 else f"{mean} ± {finite.std(ddof=1):.{digits}f}"


# Subjects: an arm of a scenario, and a real arm's logs.


def scenario_subjects(
    scenario: Scenario, arm: int, seeds: Sequence[int], size: Size, folder: Path, progress: Progress = quiet
) -> list[Subject]:
    """The twin of an arm of a scenario under each seed of its training, judged on random jobs with true outcomes.

    The first seed, 0, gives the twin with which the arm works in the scenario's fleet.

    Raises:
        FleetError: no motion of the arm stays cool.
    """
    from scenarios.motion.generate import GenerationError, Verification, bare_arm, generate

    spec = scenario.twin
    (planned,) = plan_arms(scenario, [arm], rehearsal_works(scenario), folder, progress)
    robot, motors, thermal = planned.hardware
    own = require_cool_plans(planned.all_plans, planned.hardware, scenario)
    progress("drawing jobs", 0.0)
    draw = np.random.SeedSequence([scenario.spread.seed, arm], spawn_key=(TEST_JOBS,))
    plans = random_jobs(robot, size.jobs, np.random.default_rng(draw), name="test")
    peak_c = cold_peaks(plans, motors, thermal, ambient_c=spec.ambient_c, horizon_s=spec.horizon_s)
    warning_c, hottest_c = scenario.limits.warning_c, peak_c.max(axis=1)
    kind = np.where(hottest_c <= spec.cool_c, COOL, np.where(hottest_c < warning_c, BETWEEN, HOT))
    repetitions = [max(1, int(np.ceil(spec.horizon_s / plan.cycle.duration_s))) for plan in plans]
    shown = [plans[i] for i in np.flatnonzero(kind != BETWEEN)]
    shown_hot, once = kind[kind != BETWEEN] == HOT, [1] * len(shown)
    profiles = [np.concatenate([phase.profile for phase in plan.phases]) for plan in shown]
    works = [(plan.work, plan.work.places[0].name.partition("/")[0]) for plan in shown]
    names = [f"{place} ({work.kind}, {work.payload_kg:.1f} kg)" for work, place in works]
    trained_on = [*records(own), *exploration_records(scenario, planned)]
    verification = Verification.nominal(robot, spec.ambient_c, cool_c=spec.cool_c, horizon_s=spec.horizon_s)

    def make(twin: Twin, strength: float, count: int) -> Made:
        how = {"s": strength, "count": count, "verification": verification, "fixtures": scenario.fixtures}
        try:
            made = generate(twin, bare_arm(robot, motors, thermal), own, **how)
        except GenerationError:
            return Made((), RATE_HZ, float("nan"), "none passed")
        pairs = tuple((m.source.cycle.profile, m.plan.cycle.profile) for m in made.motions)
        distance_rad = float(np.mean([m.distance_rad for m in made.motions]))
        return Made(pairs, RATE_HZ, distance_rad, f"{len(pairs)} of {made.draws} passed", made.truly_cool)

    subjects = []
    for k in seeds:
        seed = training_seed(scenario, k)
        (twin,) = train_twins(scenario, [planned], folder, progress, seed=None if k == 0 else seed)
        untrained = _untrained(trained_on, twin.config, seed, robot.name, folder)
        cut_up = cut_jobs(shown, once, twin.config)
        few = _few(shown_hot[cut_up.job], size.windows)
        subjects.append(
            Subject(
                twin=twin, untrained=untrained, joint=int(np.argmax(twin.joint_weight)), item="job",
                kinds=(f"cool, to {spec.cool_c:g} °C", "between", f"hot, from {warning_c:g} °C"),
                how=f"{len(plans)} random jobs, on none of which the twin was trained. The kind of a job is that of "
                f"its hottest motor when it repeats for {spec.horizon_s / 60:g} min, by the true heat of the arm.",
                trained_on=trained_on, kind=kind, features=twin.features(plans, repetitions),
                untrained_features=untrained.features(plans, repetitions), windows=cut_up.windows[few],
                window_hot=shown_hot[cut_up.job[few]], names=names,
                recorded_hot=shown_hot, recorded=twin.features(shown, once),
                motion=lambda i, rate_hz=twin.config.rate_hz: resample(profiles[i], RATE_HZ, rate_hz),
                cool_jobs=[records([plans[i]]) for i in np.flatnonzero(kind == COOL)],
                epoch_records=5, make=make,
            )
        )  # fmt: skip
    return subjects


def _untrained(trained_on: Sequence[Array], config: TwinConfig, seed: int, arm: str, folder: Path) -> Twin:
    entropy = np.random.SeedSequence(seed)
    return train_or_load(list(trained_on), untrained_config(config), entropy, arm=arm, folder=folder)


def _few(hot: Array, most: int) -> Array:
    """Indices of at most `most` random windows of each kind, in order."""
    chosen = (np.random.default_rng(0).permutation(np.flatnonzero(hot == kind))[:most] for kind in (False, True))
    return np.sort(np.concatenate(list(chosen)))


def log_subject(
    recordings: Sequence[Recording], seed: int, *, size: Size, folder: Path, config: TwinConfig | None = None
) -> Subject:
    """A twin trained on cool logs of an arm, chosen by the seed, and judged on all other files.

    Raises:
        FleetError: a log has no temperatures, or too few are cool.
    """
    config, joint = config or LOG_CONFIG, LOADED_JOINT
    names = training_files(recordings, seed)
    training, test = ([r for r in recordings if (r.name in names) == wanted] for wanted in (True, False))
    normal = cool_stretches(training, config.rate_hz, cool_c=LOG_HOT_C, joints=(joint,))
    trained_on = [stretch.profile for stretch in normal]
    twin = train_or_load(trained_on, config, np.random.SeedSequence(seed), arm="logged", folder=folder)
    untrained = _untrained(trained_on, config, seed, "logged", folder)
    windows, temps, owners = [], [], []
    for r in test:
        for stretch in (s for s in stretches(r, config.rate_hz) if len(s.time_s) >= config.window):
            assert stretch.temp_c is not None
            first = starts(len(stretch.time_s), config.window, config.stride)
            windows.append(cut(stretch.profile, config.window, config.stride).astype(np.float32))
            temps += [stretch.temp_c[a : a + config.window, joint].mean() for a in first]
            owners += [r.name] * len(first)
    length = f"{config.window / config.rate_hz:g} s"
    if not windows:
        raise FleetError(f"None of the {len(test)} test logs lasts {length}; add longer logs.")
    every, hot, owner = np.concatenate(windows), np.array(temps) >= LOG_HOT_C, np.array(owners)
    long, few = [r for r in test if r.name in set(owners)], _few(hot, size.windows)
    cool = [[w.transpose(0, 2, 1)] for r in long for w in every[(owner == r.name) & ~hot][:40:4]]
    own = draw_windows(windows_of(trained_on, config), size.windows, np.random.SeedSequence(seed))

    def make(network: Twin, strength: float, count: int) -> Made:
        rng = np.random.default_rng(seed)
        source = own[np.sort(rng.choice(len(own), min(count, len(own)), replace=False))]
        mu, sigma = network.posterior(source)
        decoded = network.decode((mu + strength * rng.standard_normal(mu.shape) * sigma).astype(np.float32))
        near = network.scaler.to_si(network.scaler.to_z(source))
        apart = np.sqrt(np.square(decoded - near)[..., 0].mean(axis=(1, 2)))
        pairs = tuple((a.transpose(0, 2, 1), b.transpose(0, 2, 1)) for a, b in zip(near, decoded, strict=True))
        return Made(pairs, config.rate_hz, float(apart.mean()), f"{len(pairs)} windows, not verified")

    def motion(i: int) -> Array:
        return max((stretch.profile for stretch in stretches(long[i], config.rate_hz)), key=len)

    whole = [np.concatenate([part.packed for *_, part in log_windows(twin, r)]).mean(axis=0) for r in long]
    return Subject(
        twin=twin, untrained=untrained, joint=joint, item="window",
        kinds=(f"cool, below {LOG_HOT_C:g} °C", "between", f"hot, from {LOG_HOT_C:g} °C"),
        how=f"{len(training)} of {len(recordings)} files, which never reach {LOG_HOT_C:g} °C on joint {joint + 1}, "
        f"train the twin; the other {len(test)} are tested, {len(hot)} windows of {length} of which {hot.sum()} are "
        "hot.",
        trained_on=trained_on, kind=np.where(hot, HOT, COOL), features=twin.window_features(every),
        untrained_features=untrained.window_features(every), windows=every[few], window_hot=hot[few],
        names=[r.name for r in long],
        recorded_hot=np.array([hot[owner == r.name].any() for r in long]), recorded=Features(np.stack(whole)),
        motion=motion, cool_jobs=cool, epoch_records=len(cool) // 3, make=make,
    )  # fmt: skip


def training_files(recordings: Sequence[Recording], seed: int) -> set[str]:
    """Names of `LOG_TRAIN_SHARE` of the cool recordings, drawn by the seed.

    Raises:
        FleetError: as `cool_logs`, too few are cool, or none is left to test on.
    """
    cool = cool_logs(recordings)
    count = round(LOG_TRAIN_SHARE * len(cool))
    if not 0 < count < len(recordings):
        raise FleetError(
            f"{len(cool)} of {len(recordings)} logs stay below {LOG_HOT_C:g} °C on joint {LOADED_JOINT + 1}: to train "
            f"on {LOG_TRAIN_SHARE:.0%} of them and test on the rest needs at least two; add logs of light work."
        )
    return {cool[i] for i in np.random.default_rng(seed).permutation(len(cool))[:count]}


def cool_logs(recordings: Sequence[Recording]) -> list[str]:
    """Names of the recordings that never get hot.

    Raises:
        FleetError: a recording has no temperatures.
    """
    cool = list[str]()
    for r in recordings:
        if r.temp_c is None:
            raise FleetError(f"'{r.name}' has no motor temperatures; leave it out, or log temp_c.")
        if r.temp_c[:, LOADED_JOINT].max(initial=-np.inf) < LOG_HOT_C:
            cool.append(r.name)
    return cool


# Error by epochs.


def epoch_study(
    jobs: Sequence[Sequence[Array]],
    tested: Array,
    *,
    epochs: Sequence[int],
    seeds: Sequence[int],
    config: TwinConfig,
    records: int,
    workers: int = -1,
) -> tuple[Array, Array]:
    """Mean |error| of a new twin for every number of epochs and seed, z units; each seed draws the jobs of its record.

    Args:
        jobs: Profiles [time, 3, joint] of the phases of each job, all cool; at least twice `records` of them.
        tested: Further windows, [window, time, joint, channel].
        epochs: 0 gives the initial weights.
        config: Of the twins; one restart, because the paper has none. A collapse is a result too.
        records: Jobs that make up a record.
        workers: Processes, -1 for one per core; the result does not depend on it.

    Returns:
        Mean over the windows of the training record and over those of other jobs, [2, seed, epochs, joint, channel],
        and of each test window the sum over the channels, [seed, epochs, window, joint].

    Raises:
        ValueError: too few jobs.
    """
    if records < 1 or len(jobs) < 2 * records:
        raise ValueError(f"The epoch table needs {2 * max(records, 1)} cool jobs or more (got {len(jobs)}).")
    base = replace(config, restarts=1, allow_collapse=True)
    # Longest first, so that no core ends with a long training alone.
    tasks = sorted(product(range(len(seeds)), range(len(epochs))), key=lambda task: -epochs[task[1]])
    cells = (delayed(_cell)(jobs, tested, base, epochs[e], seeds[s], records) for s, e in tasks)
    with worker_processes(min(len(tasks), cpu_count()) if workers < 0 else workers, in_order=True) as pool:
        results: dict[tuple[int, int], Any] = dict(zip(tasks, pool(cells), strict=True))  # joblib has no types
    known, new = (np.array([[results[s, e][k] for e in range(len(epochs))] for s in range(len(seeds))]) for k in (0, 1))
    return np.moveaxis(known, 2, 0), new


def _cell(
    jobs: Sequence[Sequence[Array]], tested: Array, config: TwinConfig, epochs: int, seed: int, records: int
) -> tuple[Array, Array]:
    """Errors [trained on/held out, joint, channel] and [window, joint]."""
    chosen = np.random.default_rng(np.random.SeedSequence([seed, 1])).permutation(len(jobs))
    record, others = (
        [phase for i in some for phase in jobs[i] if len(phase)]
        for some in (chosen[:records], chosen[records : 5 * records])
    )
    config = replace(config, epochs=epochs) if epochs else untrained_config(config)
    twin = train(record, config, np.random.SeedSequence(seed), arm="epochs")
    errors = [twin.window_errors(windows_of(part, config)).mean(axis=0) for part in (record, others)]
    return np.stack(errors), twin.window_errors(tested).sum(axis=-1)


# Chapters, in the order of the paper.


def data_chapter(subjects: Sequence[Subject], size: Size) -> Section:
    """Training motion, and a hot recording."""
    s = subjects[0]
    config, hot = s.twin.config, s.examples[1]
    gap = np.full((1, len(CHANNELS)), np.nan)
    parts = [resample(each, config.record_hz, config.rate_hz)[:, :, s.joint] for each in s.trained_on]
    seen = s.motion(hot)[:, :, s.joint]
    train = np.concatenate([piece for part in parts if len(part) for piece in (part, gap)])[: len(seen)]
    load = {"training data": np.square(np.concatenate(s.trained_on)[:, TAU], dtype=float)}
    load |= {f"{name} {s.item}s": s.features.torque_sq[s.kind == kind] for name, kind in (("cool", COOL), ("hot", HOT))}
    rms = {name: np.sqrt(squares.mean(axis=0)) for name, squares in load.items()}
    cells: Cells = {}
    for c in range(3):
        cells[c, 0] = [_line(train[:, c], config.rate_hz, "training data", BLUE)]
        cells[c, 1] = [_line(seen[:, c], config.rate_hz, "hot recording", ORANGE)]
    ratio = rms[f"hot {s.item}s"][s.joint] / rms["training data"][s.joint]
    rows = tuple(_row(name, values, ".2f") for name, values in rms.items())
    return Section(
        sentences=(f"RMS torque of joint {s.joint + 1}: {ratio:.1f} times as large in hot {s.item}s as in training.",),
        how=f"{s.how} Left: joint {s.joint + 1} in the first of {len(s.trained_on)} training records, one after "
        f"another. Right: {s.names[hot]}, a typical hot recording (see Reconstruction).",
        charts=_over_time("data", cells, ("training data", "hot")),
        tables=(Table(head=("RMS torque, N·m", *_joints(s)), rows=rows),),
        numbers={"rms_torque_nm": list(rms.values()), "records": len(s.trained_on)},
    )


def latent_chapter(subjects: Sequence[Subject], size: Size) -> Section:
    """The latent plane of the joint, of the twin and of the untrained network."""
    s, cells, values = subjects[0], Cells(), dict[str, float]()
    known = windows_of(s.trained_on, s.twin.config)
    for column, (name, twin) in enumerate(s.networks.items()):
        mu = twin.posterior(s.windows)[0][:, min(s.joint, len(twin.nets) - 1)]
        features = twin.window_features(known)
        distance = Calibration(features, np.zeros(len(known), int)).latent(twin.window_features(s.windows))
        values[f"latent distance, {name}"] = auroc(s.window_hot, distance[:, s.joint])
        cells[0, column] = [
            {"type": "scatter", "mode": "markers", "x": _plain(mu[kind, 0]), "y": _plain(mu[kind, 1]), "name": label}
            | {"marker": {"color": colour, "size": 4, "opacity": 0.6}}
            for kind, label, colour in ((~s.window_hot, s.kinds[COOL], BLUE), (s.window_hot, s.kinds[HOT], ORANGE))
        ]
    values["RMS torque"] = s.torque_auroc(s.windows, s.window_hot)
    first, other, torque = values.values()
    return Section(
        sentences=(
            f"The distance from the training cluster tells hot from cool windows with AUROC {first:.2f}; in the latent "
            f"space of an untrained network {other:.2f}, by RMS torque of the window {torque:.2f}.",
        ),
        how=f"Posterior means of {len(s.windows)} test windows under the network of joint {s.joint + 1}. The distance "
        "is that of Mahalanobis from the means of the training windows.",
        charts=panels("latent", cells, x="μ₁", y=("μ₂",), heads=tuple(s.networks), height=420),
        tables=(
            Table(
                head=("hot against cool windows", "AUROC"),
                rows=tuple((name, f"{value:.3f}") for name, value in values.items()),
            ),
        ),
        numbers={"auroc": values},
    )


def reconstruction_chapter(subjects: Sequence[Subject], size: Size) -> Section:
    """A whole cool and a whole hot recording, and their reconstructions in the unit of each channel."""
    s, cells, rows, errors = subjects[0], Cells(), list[tuple[str, ...]](), dict[str, Array]()
    for column, (kind, i) in enumerate(zip(("cool", "hot"), s.examples, strict=True)):
        motion, rate_hz = s.motion(i), s.twin.config.rate_hz
        made = {name: reconstruct(twin, motion) for name, twin in (("twin", s.twin), ("untrained", s.untrained))}
        for c in range(3):
            cells[c, column] = [_line(made["twin"][0][:, c, s.joint], rate_hz, "recorded", GREY)]
            cells[c, column] += [
                _line(made[name][1][:, c, s.joint], rate_hz, f"reconstructed, {name}", colour, dash)
                for name, colour, dash in (("untrained", GREEN, "dot"), ("twin", BLUE, "solid"))
            ]
        own, other = (np.abs(recorded - again)[:, :, s.joint].mean(axis=0) for recorded, again in made.values())
        errors |= {f"{kind}, twin": own, f"{kind}, untrained": other}
        usual = np.median(s.recorded.errors[s.recorded_hot == bool(column), s.joint], axis=0)
        torque = float(np.sqrt(np.square(motion[:, TAU, s.joint]).mean()))
        rows.append((*_row(f"{kind}: {s.names[i]}", own, ".3g"), f"{torque:.1f}"))
        rows.append((*_row("the same, untrained network", other, ".3g"), ""))
        rows.append((*_row(f"median of all {kind} ones", usual * s.twin.scaler.std[s.joint], ".3g"), ""))
    cool, hot = (errors[f"{kind}, twin"][TAU] for kind in ("cool", "hot"))
    return Section(
        sentences=(f"Mean error of the torque of joint {s.joint + 1}: {cool:.2f} N·m cool, {hot:.2f} N·m hot.",),
        how="Decoded from the posterior mean, window by window without overlap. Each example is the recording whose "
        "errors are nearest the median of its kind in all three channels.",
        charts=_over_time("reconstruction", cells, ("cool", "hot")),
        tables=(Table(head=("mean |error|", *CHANNEL_HEADS, "RMS torque, N·m"), rows=tuple(rows)),),
        numbers={"mean_error_si": errors, "examples": [s.names[i] for i in s.examples]},
    )


def reconstruct(twin: Twin, motion: Array) -> tuple[Array, Array]:
    """Motion [time, 3, joint] near the training data in whole turns, and its reconstruction, both [time, 3, joint]."""
    window = twin.config.window
    windows, first = cut(motion, window, window), starts(len(motion), window, window)
    result = np.zeros((2, max(len(motion), window), *motion.shape[1:]))
    for whole, values in zip(
        result, (twin.scaler.to_si(twin.scaler.to_z(windows)), twin.reconstruct(windows)), strict=True
    ):
        for start, samples in zip(first, values.transpose(0, 1, 3, 2), strict=True):
            whole[start : start + window] = samples
    return result[0, : len(motion)], result[1, : len(motion)]


def difficulty_chapter(subjects: Sequence[Subject], size: Size) -> Section:
    """Difficulty of cool and hot items, and how well it tells them apart, for each seed."""
    s = subjects[0]
    d, cells, rows = s.features.difficulty, Cells({(0, 0): []}), list[tuple[str, ...]]()

    def with_total(each: Array) -> Array:
        """d of the joints and of the arm, [..., joint + 1]."""
        return np.append(each, (each @ s.twin.joint_weight)[..., None], axis=-1)

    for kind, colour in ((COOL, BLUE), (BETWEEN, GREY), (HOT, ORANGE)):
        chosen = s.kind == kind
        if chosen.any():
            name = f"{s.kinds[kind]} ({chosen.sum()} {s.item}s)"
            quantiles = {n: _plain(np.percentile(d[chosen], q, axis=0)) for n, q in QUANTILES.items()}
            joints = [str(j + 1) for j in range(s.twin.joints)]
            cells[0, 0].append({"type": "box", "x": joints, "name": name, "marker": {"color": colour}} | quantiles)
            rows.append(_row(f"median, {name}", np.median(with_total(d[chosen]), axis=0), ".3f"))
    for name, i in zip(("cool", "hot"), s.examples, strict=True):
        rows.append(_row(f"the {name} example", with_total(s.recorded.difficulty[i]), ".3f"))
    ranks = [{name: auroc(each.kind == HOT, v) for name, v in each.scores().items()} for each in subjects]
    by_name = {name: [rank[name] for rank in ranks] for name in ranks[0]}
    first, *_, torque, other = map(spread, by_name.values())
    against = f"ot against all other {s.item}s"
    return Section(
        sentences=(
            f"H{against}: {next(iter(by_name))} has AUROC {first}, RMS torque {torque}, the untrained network {other}.",
        ),
        how="d_k = 1 − exp(−e_k), e_k the mean absolute error of joint k summed over the channels; d is their sum with "
        f"the weights of the twin. {_seeds(len(subjects))}",
        charts=panels("difficulty", cells, x="joint", y=("d of the joint",), heads=("",), height=420),
        tables=(
            Table(head=("", *_joints(s), "d"), rows=tuple(rows)),
            Table(head=(f"h{against}", "AUROC"), rows=tuple((name, spread(each)) for name, each in by_name.items())),
        ),
        numbers={"auroc": by_name},
    )


def _seeds(count: int) -> str:
    return "One seed." if count == 1 else f"{count} seeds, mean ± standard deviation; figure: the first."


def epochs_chapter(subjects: Sequence[Subject], size: Size) -> Section:
    """Reconstruction error against epochs, and how well the error then tells hot from cool."""
    s = subjects[0]
    upto = slice(s.joint + 1)  # Each joint has its own network: further ones would only take time.
    jobs = [[phase[:, :, upto] for phase in job] for job in s.cool_jobs]
    few = _few(s.window_hot, size.windows // 4)
    windows, hot, seeds = s.windows[few], s.window_hot[few], tuple(range(size.epoch_seeds))
    how = {"epochs": size.epochs, "seeds": seeds, "records": s.epoch_records}
    errors, tested = epoch_study(jobs, windows[:, :, upto], config=s.twin.config, **how)
    of_joint: dict[str, Array] = dict(zip(("trained on", "held out"), errors[:, :, :, s.joint], strict=True))
    ranks = np.array([[auroc(hot, each[:, s.joint]) for each in row] for row in tested])
    torque = s.torque_auroc(windows, hot)
    x, cells, rows = [f"{n}" if n else "untrained" for n in size.epochs], Cells(), list[tuple[str, ...]]()
    for c, channel in enumerate(CHANNEL_NAMES):
        cells[0, c] = []
        for (kind, values), colour in zip(of_joint.items(), (BLUE, GREY), strict=True):
            cells[0, c].append(_over_epochs(x, values[:, :, c], kind, colour))
            rows.append((f"{channel}, {kind}", *(spread(seeds_of, 2) for seeds_of in values[:, :, c].T)))
    cells[0, 3] = [_over_epochs(x, ranks, "error of the test windows", ORANGE)]
    cells[0, 3].append(_over_epochs(x, np.full((1, len(x)), torque), "RMS torque", GREEN))
    left = of_joint["held out"][:, -1].mean(axis=0) / of_joint["held out"][:, 0].mean(axis=0)
    rows.append(("AUROC, hot test windows", *(spread(v, 2) for v in ranks.T)))
    rows.append(_row("the same by RMS torque", [torque] * len(x), ".2f"))
    shares = ", ".join(f"{share:.0%} for {name}" for name, share in zip(CHANNEL_NAMES, left, strict=True))
    return Section(
        sentences=(
            f"After {x[-1]} epochs the error on held-out motion, relative to the first column, is {shares}. AUROC of "
            f"the error on hot windows: {spread(ranks[:, 0], 2)} in the first column, {spread(ranks[:, -1], 2)} after "
            f"{x[-1]} epochs; RMS torque {torque:.2f}.",
        ),
        how=f"A separate training for each number of epochs and each of {len(seeds)} seeds, on a record of "
        f"{s.epoch_records} cool {s.item}s; other cool {s.item}s are held out. Joint {s.joint + 1}; errors in standard "
        "deviations of the training data, mean ± standard deviation over the seeds.",
        charts=panels("epochs", cells, x="epochs", y=("mean |error| (σ)",), heads=(*CHANNEL_NAMES, "AUROC, hot")),
        tables=(Table(head=("mean |error|, σ", *x), rows=tuple(rows)),),
        numbers={"epochs": size.epochs, **of_joint, "auroc": ranks, "auroc_rms_torque": torque},
    )


def generation_chapter(subjects: Sequence[Subject], size: Size) -> Section:
    """Motion that the twin generates near its training data."""
    s, rows, numbers = subjects[0], list[tuple[str, ...]](), list[dict[str, Any]]()
    cells: Cells = {(row, column): [] for row in range(2) for column in range(2)}
    strengths = {"twin": size.strengths, "untrained network": size.strengths[1:2]}
    for column, (name, network) in enumerate(s.networks.items()):
        for strength in strengths[name]:
            made = s.make(network, strength, size.generated)
            load = (
                np.sqrt(np.mean([np.square(pair[k][:, TAU, s.joint]).mean() for pair in made.pairs])) for k in (0, 1)
            )
            figures = (f"{made.distance_rad:.3f}", *(f"{v:.1f}" for v in load)) if made.pairs else ("–", "–", "–")
            cool = "–" if made.cool_share is None else f"{made.cool_share:.0%}"
            rows.append((f"{name}, s = {strength:g}", made.outcome, *figures, cool))
            numbers.append({"network": name, "strength": strength, **vars(made), "pairs": len(made.pairs)})
            for source, motion in made.pairs[:1] if strength == size.strengths[1] else ():
                for row, c in enumerate((0, TAU)):
                    cells[row, column] = [
                        _line(motion[:, c, s.joint], made.rate_hz, "generated", GREEN if column else BLUE),
                        _line(source[:, c, s.joint], made.rate_hz, "source", GREY, "dot"),
                    ]
    ours = [each for each in numbers if each["network"] == "twin"]
    far = ", ".join(f"{each['distance_rad']:.2f} rad at s = {each['strength']:g}" for each in ours)
    known = [each["cool_share"] for each in ours if each["cool_share"] is not None]
    sentences = [f"RMS distance of the positions from the source: {far}."]
    how = "A log has no model of its arm: position and torque are shown as decoded, and nothing is verified."
    if known:
        sentences.append(f"{np.mean(known):.0%} of the accepted motions truly stay cool.")
        how = (
            "Torque follows from inverse dynamics. Accepted motions are inside the limits, predicted to stay cool and "
            "executed in MuJoCo; the true motors are only measured."
        )
    head = ("network", "result", "distance, rad", "RMS torque of source, N·m", "of motion, N·m", "truly cool")
    return Section(
        sentences=tuple(sentences),
        how=f"Latents of cool motion are perturbed, mu + s·eps·sigma, and decoded. {how} The figure shows the first "
        f"motion at s = {size.strengths[1]:g}.",
        charts=_over_time("generation", cells, tuple(s.networks), CHANNEL_HEADS[::2]),
        tables=(Table(head=head, rows=tuple(rows)),),
        numbers={"made": numbers},
    )


# Rows of tables, and charts.


def _row(name: str, values: Iterable[float], form: str) -> tuple[str, ...]:
    return (name, *(format(value, form) for value in values))


def _joints(subject: Subject) -> list[str]:
    return [f"joint {j + 1}" for j in range(subject.twin.joints)]


def _plain(values: Array) -> list[float | None]:
    """Numbers with four digits, as JSON allows them."""
    return [float(f"{v:.4g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def _line(values: Array, rate_hz: float, name: str, colour: str, dash: str = "solid") -> Trace:
    """A curve over time from samples [time]."""
    look = {"color": colour, "width": 1.3, "dash": dash}
    return curve(name, np.arange(len(values)) / rate_hz, values, look, most=MOST_POINTS)


def _over_epochs(x: Sequence[str], y: Array, name: str, colour: str) -> Trace:
    """The mean over the seeds of y [seed, epochs], with the standard deviation as bars."""
    bars = {"type": "data", "array": _plain(y.std(axis=0, ddof=1)), "thickness": 1} if len(y) > 1 else None
    look = {"mode": "lines+markers", "line": {"color": colour}, "marker": {"size": 5}, "error_y": bars}
    return {"type": "scatter", "x": list(x), "y": _plain(y.mean(axis=0)), "name": name, **look}


def _over_time(key: str, cells: Cells, heads: Sequence[str], y: Sequence[str] = CHANNEL_HEADS) -> tuple[Chart, ...]:
    """Channels over time, a row each, with the same y axis in all columns."""
    return panels(key, cells, x="time, s", y=y, heads=heads, shared=True)


def panels(
    key: str, cells: Cells, *, x: str, y: Sequence[str], heads: Sequence[str], height: int = 0, shared: bool = False
) -> tuple[Chart, ...]:
    """A grid of panels as the chart of a section.

    Args:
        key: Of the section.
        x: Title of the x axes, below the last row.
        y: Titles of the y axes of the first column.
        heads: Titles of the columns.
        shared: Give the panels of a row the same y axis.
        height: Pixels; by default by the number of rows.
    """
    from plotly.subplots import make_subplots

    rows, columns = (1 + max(place[axis] for place in cells) for axis in (0, 1))
    gap = 0.06 if shared else 0.09
    sharing = {"shared_yaxes": shared, "horizontal_spacing": gap, "vertical_spacing": 0.3 / (rows + 1)}
    figure = make_subplots(rows, columns, subplot_titles=heads, **sharing)
    named = set[str]()
    for (row, column), traces in sorted(cells.items()):
        for trace in traces:
            own = {"legendgroup": trace["name"], "showlegend": trace["name"] not in named}
            figure.add_trace(trace | own, row + 1, column + 1)
            named.add(trace["name"])
    figure.update_layout(
        LAYOUT,
        height=height or 150 + 170 * rows,
        margin={"l": 60, "r": 20, "t": 80, "b": 50},
        boxmode="group",
        legend={"orientation": "h", "x": 0, "y": 1, "yref": "container", "yanchor": "top"},
    )
    figure.update_annotations(font_size=12)
    figure.update_xaxes(AXIS, type="category" if x in ("epochs", "joint") else "-")
    figure.update_yaxes(AXIS)
    figure.update_xaxes(title_text=x, row=rows)
    for row, title in enumerate(y):
        figure.update_yaxes(title={"text": title, "standoff": 4}, automargin=True, row=row + 1, col=1)
    alt = f"{', '.join(y)} by {x}: {', '.join(filter(None, heads)) or 'cool and hot'}"
    least_px = OWN_AXES_PX if columns > 1 and not shared else 0
    return (Chart(key=f"chart_{key}", figure=figure.to_plotly_json(), alt=alt, least_px=least_px),)


# The report.

CHAPTERS: dict[str, tuple[str, Callable[[Sequence[Subject], Size], Section]]] = {
    "data": ("Training data", data_chapter),
    "latent": ("Latent map", latent_chapter),
    "reconstruction": ("Reconstruction of whole recordings", reconstruction_chapter),
    "difficulty": ("Difficulty, cool and hot", difficulty_chapter),
    "epochs": ("Error by epochs", epochs_chapter),
    "generation": ("Generated motion", generation_chapter),
}


def chapters_of(subjects: Sequence[Subject], size: Size, progress: Progress = quiet) -> list[Section]:
    """Every chapter; one that cannot be computed gives the reason."""
    chapters = []
    for done, (key, (title, compute)) in enumerate(CHAPTERS.items()):
        progress("chapters", Count(done, len(CHAPTERS)))
        try:
            chapter = compute(subjects, size)
        except (FleetError, ValueError) as error:
            chapter = Section(failed=str(error))
        chapters.append(replace(chapter, key=key, title=title))
    return chapters


def origin_of(subjects: Sequence[Subject]) -> dict[str, str]:
    """Twins, data and version from which the figures of a page come."""
    return {
        "twins": ", ".join(each.twin.version for each in subjects),
        "training data": subjects[0].twin.data_hash,
        "test data": subjects[0].how,
        "thermofleet": version("thermofleet"),
    }


def write(chapters: Sequence[Section], origin: Mapping[str, str], folder: Path, title: str) -> dict[str, str]:
    """Write page and numbers into an existing folder; returns the reasons of the chapters that failed, by key.

    The `status` in report.json is finished even where chapters failed.
    """
    page = Page(title=title, sections=chapters, head=Head(sentences=LIMITS), origin=origin_table(origin))
    (folder / PAGE).write_text(page.html(), encoding="utf-8")
    failed = {each.key: each.failed for each in chapters if each.failed}
    of_chapters = {
        each.key: {"title": each.title, "found": each.sentences, "how": each.how, "numbers": each.numbers}
        | {"tables": [{"head": one.head, "rows": one.rows} for one in each.tables]}
        for each in chapters
    }
    card = {"status": "finished", "title": title, "origin": origin, "failed": failed, "chapters": of_chapters}
    (folder / CARD).write_text(json_text(card), encoding="utf-8")
    return failed
