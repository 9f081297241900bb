"""Forecasts that joint 2 of a real arm passes 40 °C: by difficulty, by temperature, and by a thermal network.

The network is identified on the training recordings of the learned twin, and tested on all others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from fleet.errors import FleetError
from scenarios.studies.ranking import CARRIER
from scenarios.studies.real_logs import AHEAD_S, HOT_C, LogStudy, ranking
from twin.logs.heat_log import heat_logs
from twin.logs.recording import Recording
from twin.thermal.forecast import continued_peaks, planned_peaks
from twin.thermal.identify import identify
from twin.thermal.kalman import filter_log
from twin.thermal.result import Identified
from twin.thermal.thermal_twin import RcTwin

Array = np.ndarray

STEP_S = 5.0
FOLDS = 5
"""Folds of the cross-validation by files, for the score that combines others."""


@dataclass(frozen=True, kw_only=True)
class Passing:
    """Ranking of windows by whether joint 2 reaches 40 °C within the next five minutes."""

    windows: int
    passing: int
    files: int
    files_passing: int
    """Files with such windows; windows of one file are much alike."""
    auroc: dict[str, float]
    """`d`: difficulty of joint 2 in the window. `load`: torque above the reconstruction. `latent`: distance from cool
    motion. `RMS torque`: of joint 2. `temperature`: of joint 2 at its end. `rc, load continued`: peak
    predicted by the identified network if the load of the window continues. `rc, load planned`: the same with q, qd,
    tau of the next five minutes, as from a plan. `all`: logistic of d, temperature and `rc, load continued`, held out
    by files. `nominal rc, …`: by the project's defaults."""
    auprc: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class LogRc:
    """The forecast on the windows of the test files."""

    identified: Identified
    below: Passing
    """Windows at whose end joint 2 is still below 40 °C: the useful case."""
    every: Passing
    """All windows, including those already hot, which are easy."""


def log_rc(study: LogStudy, recordings: Sequence[Recording], *, identified: Identified | None = None) -> LogRc:
    """Forecasts for every test window of the study whose next five minutes were recorded.

    Args:
        recordings: Those of the study.
        identified: From the study's training files unless given.

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
    return LogRc(identified=arm, below=_passing(study, scores, below), every=_passing(study, scores, complete))


def motion_scores(study: LogStudy) -> dict[str, Array]:
    """Scores of joint 2 from the motion in the window alone, each [window]."""
    return {
        "d": study.difficulty[:, CARRIER],
        "load": study.features.one_sided[:, CARRIER],
        "latent": study.latent[:, CARRIER],
        "RMS torque": study.rms_torque[:, CARRIER],
    }


def by_motion(study: LogStudy) -> Passing:
    """The ranking by motion alone of the windows at whose end joint 2 is below 40 °C; raises as `log_rc`."""
    known = np.isfinite(study.peak_next_c[:, CARRIER]) & (study.end_c[:, CARRIER] < HOT_C)
    return _passing(study, motion_scores(study), known)


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


def _passing(study: LogStudy, scores: dict[str, Array], chosen: Array) -> Passing:
    passes, files = study.peak_next_c[chosen, CARRIER] >= HOT_C, study.file[chosen]
    if passes.all() or not passes.any():
        raise FleetError(
            f"Joint {CARRIER + 1} passes {HOT_C:g} °C after {passes.sum()} of {len(passes)} test windows: nothing to "
            "tell apart. Add logs of heavier or of lighter work."
        )
    picked = {name: values[chosen] for name, values in scores.items()}
    if "temperature" in picked and len(np.unique(files[passes])) >= FOLDS:
        picked["all"] = _together([picked[n] for n in ("d", "temperature", "rc, load continued")], passes, files)
    return Passing(
        windows=len(passes),
        passing=int(passes.sum()),
        files=len(np.unique(files)),
        files_passing=len(np.unique(files[passes])),
        **ranking(passes, picked),
    )


def _together(scores: list[Array], passes: Array, files: Array) -> Array:
    """Cross-validated score of a logistic regression, held out by files, [window]."""
    model = make_pipeline(StandardScaler(), LogisticRegression())
    folds = GroupKFold(FOLDS, shuffle=True, random_state=0)
    x = np.column_stack(scores)
    return np.asarray(cross_val_predict(model, x, passes, groups=files, cv=folds, method="decision_function"))
