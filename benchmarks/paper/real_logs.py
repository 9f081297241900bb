"""Studies on logs of a real arm: `questions` and `identification`.

`questions` ranks the windows of a log by whether joint 2 is hot or becomes hot, by d, RMS torque, and peaks predicted
by a thermal network that is identified on the training files. It is cross-validated by file: every file is judged by a
twin that was trained on cool files of other folds. Windows of one file are much alike, so the intervals are bootstraps
over files. `identification` predicts the files of one half by a network that is identified on the other half.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from pathlib import Path

import msgspec
import numpy as np
from sklearn.metrics import roc_auc_score

from benchmarks.paper.harness import Experiment, Unit, content_key, one_row, table_of, whole
from benchmarks.paper.subjects import CARRIER
from fleet.errors import FleetError, LogError
from fleet.files import cache_folder
from fleet.heat.thermal import HOUSING, WINDING, drive_heat, housing_observer, temperature_steps
from fleet.motion import CHANNELS, Drive
from fleet.robot import JOINTS
from scenarios.evaluate.statistics import Interval, percentile_interval
from scenarios.json_rows import Row
from scenarios.prepare.twins import LOG_INPUT, train_or_load
from scenarios.table import Table
from twin.logs.reader import read_folder
from twin.logs.recording import READINGS, HeatLog, Recording, Stretch, cool_stretches, heat_logs, stretches
from twin.thermal.identify import HeatModel, Noise, ParameterVector, Problem, identify
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import Calibration
from twin.vae.twin import Twin
from twin.vae.window import cut, starts, windows_of

Array = np.ndarray

FOLDS = 5
"""Folds of a cross-validation by files."""
HOT_C = 40.0
"""Mean temperature of joint 2 from which a window is hot; a file that never reaches it is cool."""
AHEAD_S = 300.0
"""Time after a window in which its peak temperature is taken."""
CONFIG = TwinConfig(record_hz=2.0, epochs=40, restarts=1).changed(**LOG_INPUT)
"""Windows of 25 s at the sampling rate of the logs, a new one every 10 samples."""
STEP_S = 5.0
"""Step of the thermal network."""
MOTION = ("d", "load", "latent", "rms_torque")
"""Scores of joint 2 from the motion in the window alone; d ranks as the error that it is a function of."""
NETWORK = ("temperature", "load continued", "load planned")
"""Scores of joint 2 that know its temperature: at the end of the window, and predicted peaks of the identified network
if the mean load of the window continues, or with q, qd, tau of the next five minutes, as from a plan."""


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
    """Every window of every file, judged by models that were not fitted on the file; all of joint 2, [window]."""

    file: Array
    """Name of the recording, str."""
    fold: Array
    """Fold of the file, int."""
    scores: Mapping[str, Array]
    """By the names of `MOTION` and `NETWORK`; the latter are NaN where the recording ends too early."""
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
FORECAST = list(QUESTIONS)[1]
"""The question that the thermal network answers too."""


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
    return Windows(scores={name: joined.pop(name) for name in (*MOTION, *NETWORK)}, **joined)


def _judged(
    test: Sequence[Recording], training: Sequence[Recording], seed: int, config: TwinConfig, folder: Path | None
) -> dict[str, Array]:
    """Fields and scores of the windows of test files, by a twin and a network of the training files."""
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
    windows, end_s = joined.pop("windows"), joined.pop("end_s")
    network = RcTwin.of(identify(training, arm="logged"))
    past_s = config.window / config.rate_hz
    continued, planned = forecasts(test, joined["file"], end_s, network, past_s=past_s)
    scores = motion_scores(twin, windows, windows_of(records, twin.config))
    network_scores = (joined["end_c"], continued, planned)
    return joined | scores | dict(zip(NETWORK, network_scores, strict=True))


def motion_scores(twin: Twin, windows: Array, known: Array) -> dict[str, Array]:
    """Scores of joint 2 by the names of `MOTION`, each [window].

    Args:
        windows: Motion, SI, [window, time, joint, channel].
        known: Windows of the training, likewise.
    """
    features, cool = twin.window_features(windows), twin.window_features(known)
    torque_sq = np.square(windows[..., CHANNELS.index("tau")], dtype=float).mean(axis=1)
    values = (
        features.errors.sum(axis=-1),
        features.one_sided,
        Calibration(cool, np.zeros(len(cool.packed), int)).latent(features),
        np.sqrt(torque_sq),
    )
    return {name: each[:, CARRIER] for name, each in zip(MOTION, values, strict=True)}


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
    end_s = stretch.time_s[last]
    return {
        "file": np.full(len(first), recording.name),
        "end_s": end_s,
        "windows": cut(stretch.profile, config.window, config.stride).astype(np.float32),
        "temp_c": np.array([temp_c[a : b + 1].mean() for a, b in zip(first, last, strict=True)]),
        "end_c": temp_c[last],
        "peak_next_c": np.array([peak_within(recording, moment, AHEAD_S)[CARRIER] for moment in end_s]),
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
        By question the numbers of windows and files and of those with the event, `auroc` of each score of `MOTION` with
        its 95 % interval over files, and `lead`: AUROC minus that of RMS torque, with the interval of the difference.
        `forecast`: the same for `FORECAST` by all scores, of the windows in which the network predicts.
    """
    motion = {name: windows.scores[name] for name in MOTION}
    predicted = np.all([np.isfinite(score) for score in windows.scores.values()], axis=0)
    found = {question: _answer(windows.file, *of(windows), motion) for question, of in QUESTIONS.items()}
    event, known = QUESTIONS[FORECAST](windows)
    found["forecast"] = _answer(windows.file, event, known & predicted, windows.scores)
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
    """Tables of the motion scores and of the forecast for each length of the windows, of its first seed."""
    tables: dict[str, Table] = {}
    for row in rows:
        answered = dict(row["answers"])
        forecast = answered.pop("forecast", None)
        of = f"windows of {row['windows']}, seed {row['seed']}"
        lines: list[tuple[str, ...]] = []
        for question, answer in answered.items():
            auroc = [bounds(each).text() for each in answer["auroc"].values()]
            leads = [bounds(each).text(sign="+") for each in answer["lead"].values()]
            lines.append((question, _counts(answer), *auroc, *leads))
        heads = ("question", "windows (files with)", "d", "load", "latent", "RMS torque")
        table = table_of(
            (*heads, "difference: d", "load", "latent"), lines, f"AUROC and its difference to that of RMS torque; {of}"
        )
        tables.setdefault(f"questions_{row['windows']}", table)
        if forecast:
            shown = {"d": "d", "rms_torque": "RMS torque", "temperature": "temperature"} | {
                name: f"network, {name}" for name in NETWORK[1:]
            }
            aurocs = [(text, bounds(forecast["auroc"][name]).text()) for name, text in shown.items()]
            caption = f"{FORECAST}: {_counts(forecast)}; {of}"
            tables.setdefault(f"forecast_{row['windows']}", table_of(("score", "AUROC"), aurocs, caption))
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
    name, basis = f"{given.window / config.rate_hz:g}s", content_key(logs, msgspec.to_builtins(config), NETWORK)
    return [
        one_row(f"{name}/{seed}/{basis}", partial(question_row, recordings, seed, config, name))
        for seed in range(given.seeds)
    ]


QUESTIONS_OF_LOGS = Experiment(
    help="Rank windows of logs by whether joint 2 is or becomes hot: by d, RMS torque, a thermal network.\n\n"
    "A twin and a network for each fold and seed: some minutes.",
    options=question_options,
    units=question_units,
    tables=question_tables,
)


def forecasts(
    recordings: Sequence[Recording], file: Array, end_s: Array, twin: RcTwin, *, past_s: float
) -> tuple[Array, Array]:
    """Predicted peak of joint 2 after each window, load continued and load planned, °C, each [window].

    Args:
        file: Name of the recording of each window, str [window].
        end_s: End of each window in the time of its recording, [window].
    """
    continued, planned = (np.full(len(end_s), np.nan) for _ in range(2))
    for recording in recordings:
        mine = np.flatnonzero(file == recording.name)
        # The past is known from measured currents; a plan has torques only.
        source = "torque" if recording.current_a is None else "current"
        logs = [heat_logs(recording, twin.motors, kind, step_s=STEP_S) for kind in (source, "torque")]
        for past, coming in zip(*logs, strict=True):
            states = estimated_temperatures(twin, past)
            edge = np.searchsorted(past.time_s, end_s[mine], side="right") - 1
            here = (edge >= 0) & (end_s[mine] <= past.time_s[-1] + STEP_S)
            for out, peaks in (
                (continued, continued_peaks(twin, past, states, AHEAD_S, past_s=past_s)),
                (planned, planned_peaks(twin, coming, states, AHEAD_S)),
            ):
                out[mine[here]] = peaks[edge[here], CARRIER]
    return continued, planned


def estimated_temperatures(twin: RcTwin, log: HeatLog) -> Array:
    """Measured motors and estimated housings at the edges of a log's steps, °C, [step + 1, node].

    The housings are those of the observer that the arms of a fleet have.
    """
    friction_w = _drive(twin, log).friction_w
    housing_c = [twin.likely_start(log.temp_c[0])[HOUSING]]
    for dt_s, motor_c, friction in zip(log.dt_s, log.middle_c, friction_w, strict=True):
        observer = housing_observer(twin.thermal, twin.motors, dt_s)
        housing_c.append(observer.step(housing_c[-1], motor_c, twin.ambient_c, friction))
    return np.concatenate([log.temp_c, np.array(housing_c)], axis=1)


def planned_peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float) -> Array:
    """Peaks within `ahead_s` after each edge of the log's steps, with the load of the log's coming steps.

    The load of a planned motion is known in advance.

    Args:
        states_c: Estimated temperatures at each edge, °C, [step + 1, node].

    Returns:
        °C, [step + 1, joint]; nan where the log ends before.
    """
    load = _drive(twin, log)
    edges = np.arange(len(log.time_s))
    until = np.searchsorted(log.time_s, log.time_s + ahead_s - 1e-9)  # first edge at or after the horizon
    temp_c = states_c.astype(float)
    peak_c = temp_c[:, WINDING]
    for ahead in range(int(np.max(until - edges, initial=0))):
        step = np.minimum(edges + ahead, len(log.dt_s) - 1)
        heat_w = drive_heat(temp_c, load.current_sq[step], load.friction_w[step], twin.motors)
        within = (edges + ahead < np.minimum(until, len(log.dt_s)))[:, None]
        temp_c = np.where(within, twin.thermal.step(temp_c, heat_w, twin.ambient_c, log.dt_s[step]), temp_c)
        peak_c = np.maximum(peak_c, temp_c[:, WINDING])
    return np.where((until < len(edges))[:, None], peak_c, np.nan)


def continued_peaks(twin: RcTwin, log: HeatLog, states_c: Array, ahead_s: float, *, past_s: float) -> Array:
    """The same if the mean load of the last `past_s` continues, without knowledge of the future.

    Returns:
        °C, [step + 1, joint]; nan at edges with less past than `past_s`.
    """
    load = _drive(twin, log)
    step_s = float(np.median(log.dt_s))
    past, count = max(1, round(past_s / step_s)), max(1, int(np.ceil(ahead_s / step_s)))
    peak_c = np.full((len(log.time_s), load.current_sq.shape[1]), np.nan)
    if len(load.current_sq) >= past:
        mean = Drive(_trailing_mean(load.current_sq, past), _trailing_mean(load.friction_w, past))
        rows = temperature_steps(
            repeat(mean, count),
            ahead_s / count,
            motors=twin.motors,
            thermal=twin.thermal,
            start_c=states_c[past:],
            ambient_c=twin.ambient_c,
        )
        peak_c[past:] = np.max([temp_c[:, WINDING] for temp_c in rows], axis=0)
    return peak_c


def _drive(twin: RcTwin, log: HeatLog) -> Drive:
    """Mean drive of each step, [step, joint]."""
    friction = (twin.motors.coulomb_nm, twin.motors.viscous_nms_per_rad)
    return Drive(log.current_sq(*friction), log.friction_w(*friction))


def _trailing_mean(values: Array, steps: int) -> Array:
    """Mean over the `steps` steps before each edge after them, [edge, joint]."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (total[steps:] - total[:-steps]) / steps


AMBIENT_C = 22.0
"""Assumed ambient temperature of the logs."""


def held_out_errors(arm: HeatModel, recording: Recording) -> tuple[Array, list[Array]]:
    """Simulated minus measured motor temperatures, K, [time, joint], and all simulated nodes per stretch.

    Only the temperatures at the start of each stretch are fitted. Resistance and magnets follow the simulated
    temperatures, which three rounds settle.
    """
    logs = heat_logs(recording, arm.motors, "current", step_s=0.0)
    layout = ParameterVector(arm)
    problem = Problem(logs, AMBIENT_C, 0.0, layout, Noise(np.full(JOINTS, 0.01), np.ones(JOINTS)))
    temps = problem.temperatures(layout.mean)
    for _ in range(2):
        middle = [(temp[1:] + temp[:-1]) / 2.0 for temp in temps]
        problem.winding_c = [each[:, WINDING] for each in middle]
        problem.housing_c = [each[:, HOUSING] for each in middle]
        temps = problem.temperatures(layout.mean)
    return np.concatenate([temp[:, WINDING] - log.temp_c for temp, log in zip(temps, logs, strict=True)]), temps


def rms(errors: Array) -> Array:
    """Root mean square over time, [joint]."""
    return np.sqrt(np.mean(errors**2, axis=0))


def fold_row(recordings: Sequence[Recording], part: int) -> Row:
    """RMS error of each file of the other half by a network of this half, K, [joint] by file."""
    arm = identify(recordings[part::2]).heat_model
    return {"rms_k": {r.name: rms(held_out_errors(arm, r)[0]).tolist() for r in recordings[1 - part :: 2]}}


def step_row(recordings: Sequence[Recording]) -> Row:
    """RMS error of joint 2 in the file with its largest rise, by a network of all other files."""
    rises_k = [0.0 if r.temp_c is None else float(np.ptp(r.temp_c[:, CARRIER])) for r in recordings]
    chosen = int(np.argmax(rises_k))
    arm = identify([r for i, r in enumerate(recordings) if i != chosen]).heat_model
    error_k = rms(held_out_errors(arm, recordings[chosen])[0])[CARRIER]
    return {"step": recordings[chosen].name, "rise_k": rises_k[chosen], "error_k": float(error_k)}


def identification_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Median and worst error of joints in held-out files, and the error of the largest rise."""
    rms_k = {name: values for row in rows if "rms_k" in row for name, values in row["rms_k"].items()}
    table = np.array(list(rms_k.values()))
    lines = [
        (f"{len(table)} files, two folds: median of joints", f"{np.median(table):.2f}"),
        ("worst joint of a file", f"{table.max():.2f}"),
    ]
    for row in rows:
        if "step" in row:
            name = f"rise of joint 2 by {row['rise_k']:.1f} K in {row['step']}, by all other files"
            lines += [
                (name, f"{row['error_k']:.2f}"),
                ("the same with two folds", f"{rms_k[row['step']][CARRIER]:.2f}"),
            ]
    caption = "Error of predicted temperatures of held-out files, only initial temperatures fitted"
    return {"identification": table_of(("", "RMS, K"), lines, caption)}


def identification_units(given: Namespace) -> list[Unit]:
    """A unit for each half, and one for the largest rise."""
    recordings, logs = recordings_given(given)
    folds = [one_row(f"fold {part}/{logs}", partial(fold_row, recordings, part)) for part in range(2)]
    return [*folds, one_row(f"step/{logs}", partial(step_row, recordings))]


IDENTIFICATION = Experiment(
    help="Predict half of the logs of an arm by a thermal network that is identified on the other half.\n\n"
    "Some minutes.",
    options=lambda parser: log_options(parser, seeds=0),
    units=identification_units,
    tables=identification_tables,
)
