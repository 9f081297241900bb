"""Studies on logs of a real arm: `questions` and `forecast`.

`questions` ranks the windows of a log by whether joint 2 is hot or becomes hot, by d, RMS torque and other scores. It
is cross-validated by file: every file is judged by a twin that was trained on cool files of other folds. Windows of one
file are much alike, so the intervals are bootstraps over files. `forecast` predicts the second half of each file from
its first.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any  # values of a row

import msgspec
import numpy as np
from sklearn.metrics import roc_auc_score

from benchmarks.paper.forms import FORMS, errors_of, fitted
from benchmarks.paper.harness import Experiment, Unit, content_key, one_row, table_of, whole
from benchmarks.paper.subjects import CARRIER
from fleet.errors import FleetError, LogError
from fleet.files import cache_folder
from fleet.motion import CHANNELS
from scenarios.evaluate.statistics import Interval, percentile_interval
from scenarios.json_rows import Row
from scenarios.prepare.twins import LOG_INPUT, train_or_load
from scenarios.table import Table
from twin.logs.reader import read_folder
from twin.logs.recording import READINGS, Recording, Stretch, cool_stretches, stretches
from twin.thermal.forecast import forecast
from twin.thermal.identify import identify
from twin.vae.config import TwinConfig
from twin.vae.measures import Calibration
from twin.vae.twin import Twin
from twin.vae.window import cut, draw_windows, starts, windows_of

Array = np.ndarray

FOLDS = 5
"""Folds of a cross-validation by files."""
HOT_C = 40.0
"""Mean temperature of joint 2 from which a window is hot; a file that never reaches it is cool."""
AHEAD_S = 300.0
"""Time after a window in which its peak temperature is taken."""
CONFIG = TwinConfig(record_hz=2.0, epochs=40, restarts=1).changed(**LOG_INPUT)
"""Windows of 25 s at the sampling rate of the logs, a new one every 10 samples."""
MOTION = ("d", "load", "latent", "explained", "rms_torque")
"""Scores of joint 2 from the motion in the window alone; d ranks as the error that it is a function of. `explained`:
error of a network that explains the torque by the motion of the joint (`forms`)."""


def log_options(parser: ArgumentParser, seeds: int) -> None:
    """Add the options that name the logs and, unless 0, the number of seeds."""
    parser.add_argument("--log", type=Path, required=True, help="folder of logs of one arm, with motor temperatures")
    parser.add_argument("--skip-damaged", action="store_true", help="skip damaged lines of a log")
    if seeds:
        parser.add_argument("--seeds", type=whole(1), default=seeds, help=f"number of seeds: 0, 1, … [{seeds}]")


def recordings_given(given: Namespace) -> tuple[list[Recording], str]:
    """The recordings of the options, and a hash of their names and lengths for keys.

    Raises:
        FleetError: names file and line, and how to go on without them.
    """
    if not given.log.is_dir():
        raise FleetError(f"--log must be a folder of logs (got '{given.log}').")
    try:
        recordings = read_folder(given.log, damaged="skip" if given.skip_damaged else "refuse")
    except LogError as error:
        raise FleetError(str(error).replace('damaged="skip"', "--skip-damaged")) from error
    return recordings, content_key([(r.name, len(r.time_s)) for r in recordings])


@dataclass(frozen=True, eq=False)
class Windows:
    """Every window of every file, judged by a twin that was not trained on the file; all of joint 2, [window]."""

    file: Array
    """Name of the recording, str."""
    fold: Array
    """Fold of the file, int."""
    scores: Mapping[str, Array]
    """By the names of `MOTION`."""
    temp_c: Array
    """Mean temperature in the window."""
    end_c: Array
    """Temperature at the last sample."""
    peak_next_c: Array
    """Highest temperature within `AHEAD_S` after the window; NaN where the recording ends before."""


QUESTIONS: Mapping[str, Callable[[Windows], tuple[Array, Array]]] = {
    f"joint 2 is at {HOT_C:g} °C or more": lambda w: (w.temp_c >= HOT_C, np.ones(len(w.file), bool)),
    f"joint 2, below {HOT_C:g} °C, passes it within 5 min": lambda w: (
        w.peak_next_c >= HOT_C,
        np.isfinite(w.peak_next_c) & (w.end_c < HOT_C),
    ),
    "joint 2 gains 1 K within 5 min": lambda w: (w.peak_next_c - w.end_c >= 1.0, np.isfinite(w.peak_next_c)),
}
"""Event of each window, and the windows for which it is known, each bool [window]."""


def judged_windows(
    recordings: Sequence[Recording], seed: int, *, config: TwinConfig = CONFIG, folder: Path | None = None
) -> Windows:
    """Every window of every file; the folds are random by the seed, stratified by hot and cool files.

    Args:
        folder: Cache of trained twins; by default that of all twins.

    Raises:
        FleetError: fewer cool files than two a fold, or no file of a fold is as long as a window.
        ValueError: a recording without temperatures.
    """
    rng = np.random.default_rng(seed)
    peaks = {r.name: float(_temperatures(r)[:, CARRIER].max(initial=-np.inf)) for r in recordings}
    cool = [name for name, peak_c in peaks.items() if peak_c < HOT_C]
    hot = [name for name, peak_c in peaks.items() if peak_c >= HOT_C]
    if len(cool) < 2 * FOLDS:
        raise FleetError(
            f"Cross-validation by file needs {2 * FOLDS} logs that stay below {HOT_C:g} °C on joint {CARRIER + 1} "
            f"(got {len(cool)})."
        )
    fold_of = {names[i]: n % FOLDS for names in (cool, hot) for n, i in enumerate(rng.permutation(len(names)))}
    parts = list[dict[str, Array]]()
    for fold in range(FOLDS):
        training = [r for r in recordings if r.name in cool and fold_of[r.name] != fold]
        part = _judged([r for r in recordings if fold_of[r.name] == fold], training, seed, config, folder)
        parts.append(part | {"fold": np.full(len(part["file"]), fold)})
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Windows(scores={name: joined.pop(name) for name in MOTION}, **joined)


def _judged(
    test: Sequence[Recording], training: Sequence[Recording], seed: int, config: TwinConfig, folder: Path | None
) -> dict[str, Array]:
    """Fields and scores of the windows of test files, by a twin of the training files."""
    normal = cool_stretches(list(map(_up_to_carrier, training)), config.rate_hz, cool_c=HOT_C, joints=(CARRIER,))
    records = [stretch.profile for stretch in normal]
    own = np.random.SeedSequence(seed)
    twin = train_or_load(records, config, own, arm="logged", folder=folder or cache_folder())
    cuts = [
        _windows(r, s, config)
        for r in map(_up_to_carrier, test)
        for s in stretches(r, config.rate_hz)
        if len(s.time_s) >= config.window
    ]
    if not cuts:
        raise FleetError(
            f"None of the {len(test)} test logs lasts {config.window / config.rate_hz:g} s; add longer logs."
        )
    joined = {name: np.concatenate([part[name] for part in cuts]) for name in cuts[0]}
    scores = motion_scores(twin, joined.pop("windows"), windows_of(records, twin.config), seed)
    return joined | scores


def motion_scores(twin: Twin, windows: Array, known: Array, seed: int) -> dict[str, Array]:
    """Scores of joint 2 by the names of `MOTION`, each [window].

    Args:
        windows: Motion, SI, [window, time, joint, channel].
        known: Windows of the training, likewise.
        seed: Of the other network.
    """
    features, cool = twin.window_features(windows), twin.window_features(known)
    torque_sq = np.square(windows[..., CHANNELS.index("tau")], dtype=float).mean(axis=1)
    values = (
        features.errors.sum(axis=-1)[:, CARRIER],
        features.one_sided[:, CARRIER],
        Calibration(cool, np.zeros(len(cool.packed), int)).latent(features)[:, CARRIER],
        _explained(twin, windows, known, seed),
        np.sqrt(torque_sq)[:, CARRIER],
    )
    return dict(zip(MOTION, values, strict=True))


def _explained(twin: Twin, windows: Array, known: Array, seed: int) -> Array:
    """Mean error of the torque of joint 2 that its motion does not explain, [window]."""
    config, form = twin.config, FORMS["motion"]
    chosen = draw_windows(known, config.max_windows, np.random.SeedSequence(seed))
    noise = np.array(config.noise) / twin.scaler.std[CARRIER]
    nothing = np.zeros(len(chosen)), np.zeros(len(windows))
    net = fitted(form, twin.scaler.to_z(chosen), nothing[0], CARRIER, noise, seed, config)
    return errors_of(net, twin.scaler.to_z(windows), nothing[1], CARRIER).mean(axis=(1, 2))


def _up_to_carrier(recording: Recording) -> Recording:
    """The recording of joints 1 and 2 alone: each joint has its own network, and only joint 2 is judged."""
    kept = {name: getattr(recording, name) for name in READINGS}
    some = {name: None if values is None else values[:, : CARRIER + 1] for name, values in kept.items()}
    return replace(recording, **some)


def _temperatures(recording: Recording) -> Array:
    if recording.temp_c is None:
        raise ValueError(f"Recording '{recording.name}' has no motor temperatures; the study needs them.")
    return recording.temp_c


def _windows(recording: Recording, stretch: Stretch, config: TwinConfig) -> dict[str, Array]:
    """The windows of one stretch, with joint 2's temperatures during, at the end of and after each."""
    assert stretch.temp_c is not None
    temp_c = stretch.temp_c[:, CARRIER]
    first = starts(len(stretch.time_s), config.window, config.stride)
    last = first + config.window - 1
    return {
        "file": np.full(len(first), recording.name),
        "windows": cut(stretch.profile, config.window, config.stride).astype(np.float32),
        "temp_c": np.array([temp_c[a : b + 1].mean() for a, b in zip(first, last, strict=True)]),
        "end_c": temp_c[last],
        "peak_next_c": np.array([peak_within(recording, moment, AHEAD_S)[CARRIER] for moment in stretch.time_s[last]]),
    }


def peak_within(recording: Recording, from_s: float, ahead_s: float) -> Array:
    """Highest temperature from `from_s` to `ahead_s` later, °C, [joint]; NaN if the recording ends before."""
    until_s = from_s + ahead_s
    if not len(recording.time_s) or recording.time_s[-1] < until_s:
        return np.full(recording.joints, np.nan)
    rows = slice(*np.searchsorted(recording.time_s, [from_s, until_s], side="right"))
    return _temperatures(recording)[rows].max(axis=0, initial=-np.inf)


DRAWS = 1000
"""Bootstrap resamples of files."""


def answers(windows: Windows) -> Row:
    """The answers to `QUESTIONS`; those without windows of both kinds in two files are left out.

    Returns:
        By question the numbers of windows and files and of those with the event, `auroc` of each score with its 95 %
        interval over files, and `lead`: AUROC minus that of RMS torque, with the interval of the difference.
    """
    found = {question: _answer(windows.file, *of(windows), windows.scores) for question, of in QUESTIONS.items()}
    return {question: answer for question, answer in found.items() if answer}


def _answer(file: Array, event: Array, known: Array, scores: Mapping[str, Array]) -> Row:
    event, file = event[known], file[known]
    files_with = len(np.unique(file[event]))
    if files_with < 2 or event.all():
        return {}
    values = {name: score[known] for name, score in scores.items()}
    resampled = _resampled(event, file, values)
    auroc = {name: float(roc_auc_score(event, score)) for name, score in values.items()}
    base = auroc["rms_torque"]
    return {
        "windows": len(event),
        "events": int(event.sum()),
        "files": len(np.unique(file)),
        "files_with": files_with,
        "auroc": {name: percentile_interval(value, resampled[name]) for name, value in auroc.items()},
        "lead": {
            name: percentile_interval(value - base, resampled[name] - resampled["rms_torque"])
            for name, value in auroc.items()
            if name != "rms_torque"
        },
    }


def _resampled(event: Array, file: Array, scores: Mapping[str, Array]) -> dict[str, Array]:
    """AUROC of each score in bootstrap resamples of the files, [draw]; resamples without both kinds are left out."""
    names, index = np.unique(file, return_inverse=True)
    rows = [np.flatnonzero(index == i) for i in range(len(names))]
    rng, resampled = np.random.default_rng(0), {name: list[float]() for name in scores}
    for _ in range(DRAWS):
        some = np.concatenate([rows[i] for i in rng.integers(len(names), size=len(names))])
        if event[some].any() and not event[some].all():
            for name, score in scores.items():
                resampled[name].append(float(roc_auc_score(event[some], score[some])))
    return {name: np.array(values) for name, values in resampled.items()}


def question_row(recordings: Sequence[Recording], seed: int, config: TwinConfig, name: str) -> Row:
    """The answers under one seed.

    Raises:
        FleetError: too few cool files, or no question has an answer.
    """
    found = answers(judged_windows(recordings, seed, config=config))
    if not found:
        raise FleetError("No question has an answer: each needs windows of both kinds, also in two files. Add logs.")
    return {"windows": name, "seed": seed, "answers": found}


def question_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """A table for each length of the windows, of its first seed."""
    tables: dict[str, Table] = {}
    for row in rows:
        lines: list[tuple[str, ...]] = []
        for question, answer in row["answers"].items():
            auroc = [bounds(each).text() for each in answer["auroc"].values()]
            leads = [bounds(each).text(sign="+") for each in answer["lead"].values()]
            lines.append((question, _counts(answer), *auroc, *leads))
        heads = ("question", "windows (files with)", "d", "load", "latent", "torque, motion known", "RMS torque")
        caption = f"AUROC and its difference to that of RMS torque; windows of {row['windows']}, seed {row['seed']}"
        differences = ("difference: d", "load", "latent", "torque, motion known")
        table = table_of((*heads, *differences), lines, caption)
        tables.setdefault(f"questions_{row['windows']}", table)
    return tables


def _counts(answer: Row) -> str:
    return f"{answer['events']} of {answer['windows']} ({answer['files_with']})"


def bounds(stored: Mapping[str, float | str | None]) -> Interval:
    """The interval of a row."""
    return msgspec.convert({name: float("nan") if value is None else value for name, value in stored.items()}, Interval)


def question_options(parser: ArgumentParser) -> None:
    """Options of `questions`."""
    log_options(parser, seeds=3)
    parser.add_argument(
        "--window", type=whole(10), default=CONFIG.window, help=f"samples, 2 a second [{CONFIG.window}]"
    )
    parser.add_argument("--epochs", type=whole(1), default=CONFIG.epochs, help=f"of each training [{CONFIG.epochs}]")


def question_units(given: Namespace) -> list[Unit]:
    """A unit for each seed."""
    recordings, logs = recordings_given(given)
    config = replace(CONFIG.changed(window=given.window), epochs=given.epochs)
    name, basis = f"{given.window / config.rate_hz:g}s", content_key(logs, msgspec.to_builtins(config))
    return [
        one_row(f"{name}/{seed}/{basis}", partial(question_row, recordings, seed, config, name))
        for seed in range(given.seeds)
    ]


QUESTIONS_OF_LOGS = Experiment(
    help="Rank windows of logs by whether joint 2 is or becomes hot: by d and RMS torque.\n\n"
    "A twin for each fold and seed: some minutes.",
    options=question_options,
    units=question_units,
    tables=question_tables,
)


LEAST_S = 120.0
"""Shorter recordings have no half from which to forecast."""


def forecast_row(recordings: Sequence[Recording], part: int) -> Row:
    """Forecasts of the second half of each file of one half of the files, made from its first half.

    Returns:
        By network, nominal or identified from the other half of the files, [file, joint]: errors of the median at the
        end, and how far the ends of the 95 % intervals are from the measured temperature, K; and of each file its
        length and how far its temperatures changed.
    """
    files = [each for each in recordings[1 - part :: 2] if each.duration_s >= LEAST_S]
    networks = {"nominal": None, "identified": identify(recordings[part::2])}
    row: dict[str, Any] = {"seconds": [], "change_k": [], **{name: [] for name in networks}}
    for recording in files:
        middle = int(np.searchsorted(recording.time_s, (recording.time_s[0] + recording.time_s[-1]) / 2.0))
        first, second = recording.part(slice(None, middle + 1)), recording.part(slice(middle, None))
        assert first.temp_c is not None, "identify refuses logs without temperatures"
        assert second.temp_c is not None, "as the first"
        row["seconds"].append(recording.duration_s)
        row["change_k"].append(np.round(second.temp_c[-1] - first.temp_c[-1], 3).tolist())
        for name, network in networks.items():
            ends = [each[-1] - second.temp_c[-1] for each in forecast(first, second, network=network).interval()]
            row[name].append(np.round(ends, 3).tolist())
    return row


def forecast_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Errors at the end of joint 2 and of the worst joint beside persistence, by network and length of the file."""

    def stacked(name: str) -> Array:
        return np.concatenate([np.array(row[name]) for row in rows])

    order = np.argsort(stacked("seconds"))
    parts = {"all": order} | dict(zip(LENGTHS, np.array_split(order, 3), strict=True))
    ends = {f"{name} network": stacked(name) for name in ("nominal", "identified")}
    errors = {name: each[:, 1] for name, each in ends.items()} | {"as it is now": stacked("change_k")}
    lines: list[tuple[str, ...]] = []
    for (length, part), (name, error) in product(parts.items(), errors.items()):
        of_files = np.abs(error[part])
        cells = (
            f"{q:.2f}" for each in (of_files[:, 1], of_files.max(axis=1)) for q in np.percentile(each, (50, 95, 100))
        )
        interval = ("", "")
        if name in ends:
            low, high = (ends[name][part][:, i] for i in (0, 2))
            interval = (f"{((low <= 0) & (high >= 0)).mean():.1%}", f"{(high - low).mean():.2f}")
        lines.append((f"{length} ({len(part)})", name, *cells, *interval))
    heads = (
        "files",
        "forecast",
        *(f"{what}, {q}" for what in ("joint 2", "worst joint") for q in ("median", "p95", "worst")),
    )
    return {"forecast": table_of((*heads, "in the interval", "its mean width"), lines)}


LENGTHS = ("shortest third", "middle third", "longest third")


def forecast_units(given: Namespace) -> list[Unit]:
    """A unit for each half of the files."""
    recordings, logs = recordings_given(given)
    return [one_row(f"fold {part}/{logs}", partial(forecast_row, recordings, part)) for part in range(2)]


FORECAST = Experiment(
    help="Forecast the second half of each log of an arm from its first half, by a nominal thermal network and by one "
    "that is identified from half of the other logs.\n\nTwo minutes.",
    options=lambda parser: log_options(parser, seeds=0),
    units=forecast_units,
    tables=forecast_tables,
)
