"""On which questions about a real arm's logs d is ahead of RMS torque, cross-validated by file.

Every file is judged by a twin that was trained on cool files of other folds. Windows of one file are much alike, so the
intervals are bootstraps over files.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_auc_score

from fleet.errors import FleetError
from scenarios.evaluate.statistics import Interval, percentile_interval
from scenarios.progress import Count, Progress, quiet
from scenarios.studies.ranking import CARRIER
from scenarios.studies.real_logs import CONFIG, HOT_C, LogStudy, recording_peaks, study_of
from twin.logs.recording import READINGS, Recording
from twin.vae.config import TwinConfig

Array = np.ndarray

FOLDS = 5
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
    progress: Progress = quiet,
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
        progress("judging logs", Count(fold, FOLDS))
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


@dataclass(frozen=True, kw_only=True)
class Answer:
    """How well each score answers one question."""

    windows: int
    events: int
    files: int
    files_with: int
    """Files with such windows."""
    auroc: dict[str, Interval]
    """Of each score, with its 95 % interval over files."""
    lead: dict[str, Interval]
    """AUROC minus that of RMS torque, with the interval of the difference."""


def answers(windows: Windows) -> dict[str, Answer]:
    """The answers to `QUESTIONS`; those without windows of both kinds in two files are left out."""
    result = dict[str, Answer]()
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
        result[question] = Answer(
            windows=len(event),
            events=int(event.sum()),
            files=len(np.unique(file)),
            files_with=with_event,
            auroc={name: percentile_interval(value, drawn[name]) for name, value in auroc.items()},
            lead={
                name: percentile_interval(value - base, drawn[name] - drawn["rms_torque"])
                for name, value in auroc.items()
                if name != "rms_torque"
            },
        )
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
