"""Studies on logs of a real arm: `questions`, `forecast` and `identification`.

`questions` asks on which questions about the heat of joint 2 d is ahead of RMS torque, cross-validated by file: every
file is judged by a twin that was trained on cool files of other folds. Windows of one file are much alike, so the
intervals are bootstraps over files. `forecast` ranks windows by whether joint 2 passes 40 °C within five minutes: by
motion, by temperature, and by a thermal network that is identified on the training files. `identification` predicts the
files of one half by a network that is identified on the other half.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import repeat
from pathlib import Path

import msgspec
import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import average_precision_score, roc_auc_score
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks.paper.harness import Experiment, Unit, content_key, one_row, table_of, whole
from benchmarks.paper.subjects import CARRIER
from fleet.difficulty import difficulty_of_error
from fleet.errors import FleetError, LogError
from fleet.files import cache_folder
from fleet.heat.thermal import HOUSING, NODES, WINDING, drive_heat, temperature_steps
from fleet.motion import CHANNELS, Drive
from fleet.robot import JOINTS
from scenarios.evaluate.statistics import Interval, percentile_interval
from scenarios.json_rows import Row
from scenarios.prepare.twins import LOG_INPUT, train_or_load
from scenarios.table import Table
from twin.logs.reader import read_folder
from twin.logs.recording import READINGS, HeatLog, Recording, Stretch, cool_stretches, heat_logs, stretches
from twin.thermal.identify import HeatModel, Identified, Noise, ParameterVector, Problem, identify
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import Calibration, Features
from twin.vae.twin import Twin
from twin.vae.window import cut, starts, windows_of

Array = np.ndarray

FOLDS = 5
"""Folds of a cross-validation by files."""
HOT_C = 40.0
"""Mean temperature of joint 2 from which a window is hot; a file that never reaches it is cool."""
AHEAD_S = 300.0
"""Time after a window in which its peak temperature is taken."""
TRAIN_SHARE = 0.6
"""Share of the cool files that train the twin."""
CONFIG = TwinConfig(record_hz=2.0, epochs=40, restarts=1).changed(**LOG_INPUT)
"""Windows of 25 s at the sampling rate of the logs, a new one every 10 samples."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class LogStudy:
    """One twin and every window of the held-out files, which are all but the training files."""

    twin: Twin
    train_files: tuple[str, ...]
    """Recordings that the twin was trained on; none of them reaches `HOT_C` on joint 2."""
    file: Array
    """Name of the recording of each window, str [window]."""
    start_s: Array
    """Middle of its first sample in the recording's time, [window]."""
    end_s: Array
    """Middle of its last sample, [window]."""
    windows: Array
    """Motion, SI, float32 [window, time, joint, channel]."""
    temp_c: Array
    """Mean motor temperature in the window, [window, joint]."""
    end_c: Array
    """Motor temperature at its last sample, [window, joint]."""
    peak_next_c: Array
    """Highest temperature within `AHEAD_S` after its end; nan where the recording ends before, [window, joint]."""
    features: Features
    """[window, joint]."""
    known: Features
    """Of the training windows, [window, joint]."""

    @property
    def errors(self) -> Array:
        """Time mean of the absolute error in training standard deviations, [window, joint, channel]."""
        return self.features.errors

    @cached_property
    def latent(self) -> Array:
        """Distance from the cluster of the training windows in the latent space, [window, joint]."""
        return Calibration(self.known, np.zeros(len(self.known.packed), int)).latent(self.features)

    @property
    def difficulty(self) -> Array:
        """d_k = 1 − exp(−sum of the errors), [window, joint]."""
        return difficulty_of_error(self.errors.sum(axis=-1))

    @property
    def rms_torque(self) -> Array:
        """N·m, [window, joint]: a baseline without training."""
        return np.sqrt(np.square(self.windows[..., CHANNELS.index("tau")], dtype=float).mean(axis=1))


def log_study(
    recordings: Sequence[Recording], seed: int, *, config: TwinConfig = CONFIG, folder: Path | None = None
) -> LogStudy:
    """A twin trained on `TRAIN_SHARE` of the cool files, drawn by the seed, and its errors on all other files.

    Args:
        folder: Cache of trained twins; by default that of all twins.

    Raises:
        FleetError: too few files are cool, or none is left to test on.
        ValueError: a recording without temperatures.
    """
    cool = [name for name, peak_c in recording_peaks(recordings).items() if peak_c < HOT_C]
    count = round(TRAIN_SHARE * len(cool))
    if not 0 < count < len(recordings):
        raise FleetError(
            f"{len(cool)} of {len(recordings)} logs stay below {HOT_C:g} °C on joint {CARRIER + 1}: to train on "
            f"{TRAIN_SHARE:.0%} of them and test on the rest needs at least two; add logs of light work."
        )
    names = {cool[i] for i in np.random.default_rng(seed).permutation(len(cool))[:count]}
    return study_of(recordings, names, seed, config=config, folder=folder)


def study_of(
    recordings: Sequence[Recording],
    names: Collection[str],
    seed: int,
    *,
    config: TwinConfig = CONFIG,
    folder: Path | None = None,
) -> LogStudy:
    """A twin trained on the cool parts of the named recordings, and its errors on all others; as `log_study`."""
    training, test = ([r for r in recordings if (r.name in names) == wanted] for wanted in (True, False))
    normal = cool_stretches(training, config.rate_hz, cool_c=HOT_C, joints=(CARRIER,))
    records = [stretch.profile for stretch in normal]
    own = np.random.SeedSequence(seed)
    twin = train_or_load(records, config, own, arm="logged", folder=folder or cache_folder())
    parts = [
        _windows(r, s, config) for r in test for s in stretches(r, config.rate_hz) if len(s.time_s) >= config.window
    ]
    if not parts:
        raise FleetError(
            f"None of the {len(test)} test logs lasts {config.window / config.rate_hz:g} s; add longer logs."
        )
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return LogStudy(
        twin=twin,
        train_files=tuple(r.name for r in training),
        features=twin.window_features(joined["windows"]),
        known=twin.window_features(windows_of(records, twin.config)),
        **joined,
    )


def ranking(event: Array, scores: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """AUROC and AUPRC of scores [window] for an event, bool [window]: [measure][score]."""
    measures = {"auroc": roc_auc_score, "auprc": average_precision_score}
    return {m: {name: float(of(event, score)) for name, score in scores.items()} for m, of in measures.items()}


def recording_peaks(recordings: Sequence[Recording]) -> dict[str, float]:
    """Highest temperature of joint 2 in each recording, °C; raises ValueError for one without temperatures."""
    return {r.name: float(_temperatures(r)[:, CARRIER].max(initial=-np.inf)) for r in recordings}


def _temperatures(recording: Recording) -> Array:
    if recording.temp_c is None:
        raise ValueError(f"Recording '{recording.name}' has no motor temperatures; the study needs them.")
    return recording.temp_c


def _windows(recording: Recording, stretch: Stretch, config: TwinConfig) -> dict[str, Array]:
    """The windows of one stretch, with the temperatures during, at the end of and after each."""
    assert stretch.temp_c is not None
    first = starts(len(stretch.time_s), config.window, config.stride)
    last = first + config.window - 1
    end_s = stretch.time_s[last]
    temps = np.stack([stretch.temp_c[a : b + 1].mean(axis=0) for a, b in zip(first, last, strict=True)])
    return {
        "file": np.full(len(first), recording.name),
        "start_s": stretch.time_s[first],
        "end_s": end_s,
        "windows": cut(stretch.profile, config.window, config.stride).astype(np.float32),
        "temp_c": temps,
        "end_c": stretch.temp_c[last],
        "peak_next_c": np.stack([peak_within(recording, moment, AHEAD_S) for moment in end_s]),
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
RISE_K = 1.0
"""Joint 2 warms up if it gains this within five minutes after a window."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Every window of every file, judged by twins that were not trained on the file."""

    file: Array
    """Name of the recording, str [window]."""
    fold: Array
    """Which twin judged it, int [window]."""
    scores: Mapping[str, Array]
    """Scores of joint 2 by name, [window]."""
    temp_c: Array
    """Mean temperature of joint 2 in the window, [window]."""
    end_c: Array
    """At its end."""
    peak_next_c: Array
    """Highest in the next five minutes; NaN where the recording ends before."""


SCORES: Mapping[str, Callable[[LogStudy], Array]] = {
    "d": lambda study: study.errors[:, CARRIER].sum(axis=-1),
    "load": lambda study: study.features.one_sided[:, CARRIER],
    "latent": lambda study: study.latent[:, CARRIER],
    "rms_torque": lambda study: study.rms_torque[:, CARRIER],
}
"""Of joint 2; `d` ranks as the error that it is a function of."""
QUESTIONS: Mapping[str, Callable[[Windows], tuple[Array, Array]]] = {
    f"joint 2 is at {HOT_C:g} °C or more": lambda w: (w.temp_c >= HOT_C, np.ones(len(w.file), bool)),
    f"joint 2, below {HOT_C:g} °C, passes it within 5 min": lambda w: (
        w.peak_next_c >= HOT_C,
        np.isfinite(w.peak_next_c) & (w.end_c < HOT_C),
    ),
    f"joint 2 gains {RISE_K:g} K within 5 min": lambda w: (
        w.peak_next_c - w.end_c >= RISE_K,
        np.isfinite(w.peak_next_c),
    ),
}
"""Event of each window, and the windows for which it is known, each bool [window]."""


def judged_windows(
    recordings: Sequence[Recording],
    seed: int,
    *,
    config: TwinConfig = CONFIG,
    folder: Path | None = None,
) -> Windows:
    """Every window of every file, by `FOLDS` twins; the folds are drawn by the seed, hot and cool files apart.

    Raises:
        FleetError: fewer cool files than folds.
    """
    recordings = [_up_to_carrier(recording) for recording in recordings]
    rng, peaks = np.random.default_rng(seed), recording_peaks(recordings)
    cool = [r.name for r in recordings if peaks[r.name] < HOT_C]
    hot = [r.name for r in recordings if peaks[r.name] >= HOT_C]
    if len(cool) < 2 * FOLDS:
        raise FleetError(
            f"Cross-validation by file needs {2 * FOLDS} logs that stay below {HOT_C:g} °C on joint {CARRIER + 1} "
            f"(got {len(cool)})."
        )
    fold_of = {names[i]: n % FOLDS for names in (cool, hot) for n, i in enumerate(rng.permutation(len(names)))}
    parts = list[dict[str, Array]]()
    for fold in range(FOLDS):
        training = {name for name in cool if fold_of[name] != fold}
        asked = [r for r in recordings if r.name in training or fold_of[r.name] == fold]
        study = study_of(asked, training, seed, config=config, folder=folder)
        moments = {name: getattr(study, name)[:, CARRIER] for name in ("temp_c", "end_c", "peak_next_c")}
        own = {name: score(study) for name, score in SCORES.items()}
        parts.append({"file": study.file, "fold": np.full(len(study.file), fold), **moments, **own})
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Windows(scores={name: joined.pop(name) for name in SCORES}, **joined)


def _up_to_carrier(recording: Recording) -> Recording:
    """The recording of joints 1 and 2 alone: each joint has a network of its own, and only joint 2 is judged."""
    kept = {name: getattr(recording, name) for name in READINGS}
    some = {name: None if values is None else values[:, : CARRIER + 1] for name, values in kept.items()}
    return replace(recording, **some)


def answers(windows: Windows) -> Row:
    """The answers to `QUESTIONS`; those without windows of both kinds in two files are left out.

    Returns:
        By question the numbers of windows and files and of those with the event, `auroc` of each score with its 95 %
        interval over files, and `lead`: AUROC minus that of RMS torque, with the interval of the difference.
    """
    result: Row = {}
    for question, of in QUESTIONS.items():
        event, known = of(windows)
        event, file = event[known], windows.file[known]
        with_event = len(np.unique(file[event]))
        if with_event < 2 or event.all():
            continue
        values = {name: score[known] for name, score in windows.scores.items()}
        drawn = _resampled(event, file, values)
        auroc = {name: float(roc_auc_score(event, score)) for name, score in values.items()}
        base = auroc["rms_torque"]
        result[question] = {
            "windows": len(event),
            "events": int(event.sum()),
            "files": len(np.unique(file)),
            "files_with": with_event,
            "auroc": {name: percentile_interval(value, drawn[name]) for name, value in auroc.items()},
            "lead": {
                name: percentile_interval(value - base, drawn[name] - drawn["rms_torque"])
                for name, value in auroc.items()
                if name != "rms_torque"
            },
        }
    return result


def _resampled(event: Array, file: Array, scores: Mapping[str, Array]) -> dict[str, Array]:
    """AUROC of each score in bootstrap resamples of the files, [draw]; resamples without both kinds are left out."""
    names, index = np.unique(file, return_inverse=True)
    rows = [np.flatnonzero(index == i) for i in range(len(names))]
    rng, drawn = np.random.default_rng(0), {name: list[float]() for name in scores}
    for _ in range(DRAWS):
        some = np.concatenate([rows[i] for i in rng.integers(len(names), size=len(names))])
        if event[some].any() and not event[some].all():
            for name, score in scores.items():
                drawn[name].append(float(roc_auc_score(event[some], score[some])))
    return {name: np.array(values) for name, values in drawn.items()}


def question_row(recordings: Sequence[Recording], seed: int, config: TwinConfig, name: str) -> Row:
    """The answers under one seed.

    Raises:
        FleetError: fewer cool files than folds, or no question has an answer.
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
            windows = f"{answer['events']} of {answer['windows']} ({answer['files_with']})"
            lines.append((question, windows, *auroc, *leads))
        heads = ("question", "windows (files with)", "d", "load", "latent", "RMS torque")
        caption = f"AUROC and its difference to that of RMS torque; windows of {row['windows']}, seed {row['seed']}"
        table = table_of((*heads, "difference: d", "load", "latent"), lines, caption)
        tables.setdefault(f"questions_{row['windows']}", table)
    return tables


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
    help="On which questions about an arm's heat d of joint 2 is ahead of RMS torque, cross-validated by file.\n\n"
    "A twin for each fold and seed: some minutes.",
    options=question_options,
    units=question_units,
    tables=question_tables,
)

STEP_S = 5.0


def log_rc(study: LogStudy, recordings: Sequence[Recording], *, identified: Identified | None = None) -> Row:
    """Rankings of every test window whose next five minutes were recorded, by whether joint 2 reaches 40 °C in these.

    Args:
        recordings: Those of the study.
        identified: From the study's training files unless given.

    Returns:
        `below`: of windows at whose end joint 2 is still below 40 °C, the useful case; `every`: of all. Each has the
        number of windows, of those that pass, of files and of files with such windows, AUROC and AUPRC by score. `d`:
        difficulty of joint 2 in the window. `load`: torque above the reconstruction. `latent`: distance from cool
        motion. `RMS torque`: of joint 2. `temperature`: of joint 2 at its end. `rc, load continued`: peak predicted by
        the identified network if the load of the window continues. `rc, load planned`: the same with q, qd, tau of the
        next five minutes, as from a plan. `all`: logistic of d, temperature and `rc, load continued`, held out by
        files. `nominal rc, …`: by the project's defaults.

    Raises:
        FleetError: joint 2 passes 40 °C in no test window, or in all.
    """
    by_name = {r.name: r for r in recordings}
    arm = identified or identify([by_name[name] for name in study.train_files], arm="logged")
    scores = {**motion_scores(study), "temperature": study.end_c[:, CARRIER]}
    for label, twin in (("rc", RcTwin.of(arm)), ("nominal rc", RcTwin.nominal())):
        continued, planned = forecasts(study, by_name, twin)
        scores |= {f"{label}, load continued": continued, f"{label}, load planned": planned}
    complete = np.isfinite(study.peak_next_c[:, CARRIER]) & np.all([np.isfinite(s) for s in scores.values()], axis=0)
    below = complete & (study.end_c[:, CARRIER] < HOT_C)
    return {"below": _passing(study, scores, below), "every": _passing(study, scores, complete)}


def motion_scores(study: LogStudy) -> dict[str, Array]:
    """Scores of joint 2 from the motion in the window alone, each [window]."""
    return {
        "d": study.difficulty[:, CARRIER],
        "load": study.features.one_sided[:, CARRIER],
        "latent": study.latent[:, CARRIER],
        "RMS torque": study.rms_torque[:, CARRIER],
    }


def forecasts(study: LogStudy, recordings: dict[str, Recording], twin: RcTwin) -> tuple[Array, Array]:
    """Predicted peak of joint 2 after each window, load continued and load planned, °C, each [window]."""
    continued, planned = (np.full(len(study.end_s), np.nan) for _ in range(2))
    past_s = study.windows.shape[1] / study.twin.config.rate_hz
    for name in np.unique(study.file):
        mine = np.flatnonzero(study.file == name)
        # Measured currents tell the past; a plan has torques only.
        logs = [heat_logs(recordings[name], twin.motors, kind, step_s=STEP_S) for kind in ("current", "torque")]
        for past, coming in zip(*logs, strict=True):
            states = filter_log(twin, past)
            edge = np.searchsorted(past.time_s, study.end_s[mine], side="right") - 1
            here = (edge >= 0) & (study.end_s[mine] <= past.time_s[-1] + STEP_S)
            for out, peaks in (
                (continued, continued_peaks(twin, past, states, AHEAD_S, past_s=past_s)),
                (planned, planned_peaks(twin, coming, states, AHEAD_S)),
            ):
                out[mine[here]] = peaks[edge[here], CARRIER]
    return continued, planned


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


HOUSING_SD_K = 5.0
"""Standard deviation of a housing from its winding at the start."""
SENSOR_SD_K = 0.05
"""Noise and slow drift of the motor temperature; larger than the noise at rest, which no model follows."""
HEAT_NOISE_W2S = 10.0
"""Intensity of unmodelled heat, W²·s, at every node: half a watt that lasts 20 s, three watts for one."""


def filter_log(twin: RcTwin, log: HeatLog) -> Array:
    """Temperatures of all nodes at the edges of a log's steps, each from the past alone, °C, [step + 1, node].

    Housings start as warm as their windings.
    """
    temp = twin.likely_start(log.temp_c[0])
    spread = np.diag(np.append(np.full(JOINTS, SENSOR_SD_K**2), np.full(JOINTS, HOUSING_SD_K**2)))
    temps = [temp]
    lengths, which = np.unique(np.round(log.dt_s, 2), return_inverse=True)
    steps = [twin.thermal.step_matrices(dt) for dt in lengths]
    # A recorded current does not depend on the magnets.
    motors = twin.motors if log.source == "torque" else replace(twin.motors, alpha_kt_per_k=0.0)
    square = log.current_sq(motors.coulomb_nm, motors.viscous_nms_per_rad)
    friction = log.friction_w(motors.coulomb_nm, motors.viscous_nms_per_rad)
    for k, length in enumerate(which):
        phi, gamma = steps[length]
        heat_w = drive_heat(temp, square[k], friction[k], motors)
        temp = phi @ temp + gamma @ (heat_w + twin.thermal.to_ambient * twin.ambient_c)
        # White heat noise over dt is like an independent constant heat of variance intensity/dt in each step.
        spread = phi @ spread @ phi.T + gamma @ gamma.T * (HEAT_NOISE_W2S / log.dt_s[k])
        temp, spread = _correct(temp, spread, log.temp_c[k + 1])
        temps.append(temp)
    return np.array(temps)


def _correct(temp: Array, spread: Array, measured_c: Array) -> tuple[Array, Array]:
    """State and covariance after a reading of all windings (Joseph's form keeps the covariance symmetric)."""
    of_reading = spread[WINDING, WINDING] + np.eye(JOINTS) * SENSOR_SD_K**2
    gain = np.linalg.solve(of_reading, spread[WINDING]).T  # [node, joint]
    rest = np.eye(NODES)
    rest[:, WINDING] -= gain
    return temp + gain @ (measured_c - temp[WINDING]), rest @ spread @ rest.T + gain @ gain.T * SENSOR_SD_K**2


def _passing(study: LogStudy, scores: dict[str, Array], chosen: Array) -> Row:
    passes, files = study.peak_next_c[chosen, CARRIER] >= HOT_C, study.file[chosen]
    if passes.all() or not passes.any():
        raise FleetError(
            f"Joint {CARRIER + 1} passes {HOT_C:g} °C after {passes.sum()} of {len(passes)} test windows: nothing to "
            "tell apart. Add logs of heavier or of lighter work."
        )
    picked = {name: values[chosen] for name, values in scores.items()}
    if "temperature" in picked and len(np.unique(files[passes])) >= FOLDS:
        picked["all"] = _together([picked[n] for n in ("d", "temperature", "rc, load continued")], passes, files)
    counts = {"windows": len(passes), "passing": int(passes.sum()), "files": len(np.unique(files))}
    return counts | {"files_passing": len(np.unique(files[passes]))} | ranking(passes, picked)


def _together(scores: list[Array], passes: Array, files: Array) -> Array:
    """Cross-validated score of a logistic regression, held out by files, [window]."""
    model = make_pipeline(StandardScaler(), LogisticRegression())
    folds = GroupKFold(FOLDS, shuffle=True, random_state=0)
    x = np.column_stack(scores)
    return np.asarray(cross_val_predict(model, x, passes, groups=files, cv=folds, method="decision_function"))


def forecast_row(recordings: Sequence[Recording], seed: int, epochs: int) -> Row:
    """The ranking under one seed."""
    return {"seed": seed, **log_rc(log_study(recordings, seed, config=replace(CONFIG, epochs=epochs)), recordings)}


def forecast_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """AUROC of each score under each seed, of windows below 40 °C and of all."""
    heads = ("score", *(f"{part}, seed {row['seed']}" for part in ("below 40 °C", "all") for row in rows))
    lines = [
        (name, *(f"{row[part]['auroc'][name]:.2f}" for part in ("below", "every") for row in rows))
        for name in rows[0]["below"]["auroc"]
    ]
    first = rows[0]["below"]
    caption = f"AUROC for: joint 2 passes 40 °C within 5 min; {first['passing']} of {first['windows']} windows below"
    return {"forecast": table_of(heads, lines, caption)}


def forecast_options(parser: ArgumentParser) -> None:
    """Options of `forecast`."""
    log_options(parser, seeds=3)
    parser.add_argument("--epochs", type=whole(1), default=10, help="of each training [10]")


def forecast_units(given: Namespace) -> list[Unit]:
    """A unit for each seed."""
    recordings, logs = recordings_given(given)
    basis = content_key(logs, given.epochs, msgspec.to_builtins(CONFIG))
    return [
        one_row(f"{seed}/{basis}", partial(forecast_row, recordings, seed, given.epochs)) for seed in range(given.seeds)
    ]


FORECAST = Experiment(
    help="Rank windows of logs by whether joint 2 passes 40 °C: by motion, temperature and an identified network.\n\n"
    "Two minutes for each seed.",
    options=forecast_options,
    units=forecast_units,
    tables=forecast_tables,
)

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
