"""Twins trained on cool logs of a real arm, tested on hot ones: the paper's claim on held-out files."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from sklearn.metrics import average_precision_score, roc_auc_score

from fleet.difficulty import difficulty_of_error
from fleet.errors import FleetError
from fleet.files import cache_folder
from fleet.motion import CHANNELS
from scenarios.prepare.train_twins import train_or_load
from scenarios.prepare.twin_folder import LOG_INPUT
from scenarios.studies.ranking import CARRIER
from twin.logs.recording import Recording
from twin.logs.resampling import Stretch, stretches
from twin.training_data import cool_stretches
from twin.vae.config import TwinConfig
from twin.vae.measures import Calibration, Features
from twin.vae.twin import Twin
from twin.vae.window import cut, starts, windows_of

Array = np.ndarray

HOT_C = 40.0
"""Mean temperature of joint 2 from which a window is hot; a file that never reaches it is cool."""
AHEAD_S = 300.0
"""Time after a window in which its peak temperature is taken."""
TRAIN_SHARE = 0.6
"""Share of the cool files that train the twin."""
CONFIG = TwinConfig(record_hz=2.0, epochs=40, restarts=1).changed(**LOG_INPUT)
"""Windows of 25 s at the sampling rate of the logs, a new one every 10 samples."""


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
    def hot(self) -> Array:
        """Windows in which joint 2 is at `HOT_C` or more on average, bool [window]."""
        return self.temp_c[:, CARRIER] >= HOT_C

    @property
    def difficulty(self) -> Array:
        """d_k = 1 − exp(−sum of the errors), [window, joint]."""
        return difficulty_of_error(self.errors.sum(axis=-1))

    @property
    def rms_torque(self) -> Array:
        """N·m, [window, joint]: a baseline without training."""
        return np.sqrt(np.square(self.windows[..., CHANNELS.index("tau")], dtype=float).mean(axis=1))


@dataclass(frozen=True, kw_only=True, eq=False)
class HotAndCool:
    """Errors and scores of joint 2 in hot and in cool windows of the test files."""

    cool_windows: int
    hot_windows: int
    cool_error: Array
    """Mean over windows of the absolute error per channel q, qd, tau, z units."""
    hot_error: Array
    ratio: float
    """Hot over cool, of the mean over windows of the error summed over channels."""
    cool_difficulty: float
    """Median d_2."""
    hot_difficulty: float
    ranking: dict[str, dict[str, float]]
    """AUROC and AUPRC of hot against cool by d_2, by the error of each channel, by torque above the reconstruction
    (load), by the latent distance, and by RMS torque."""


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
    normal = cool_stretches(training, config.rate_hz, cool_c=HOT_C, horizon_s=np.inf, joints=(CARRIER,))
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


def hot_and_cool(study: LogStudy) -> HotAndCool:
    """The errors of joint 2 in hot against cool test windows.

    Raises:
        FleetError: all test windows are hot, or none.
    """
    hot = study.hot
    if hot.all() or not hot.any():
        raise FleetError(
            f"{hot.sum()} of {len(hot)} test windows are hot (joint 2 at {HOT_C:g} °C): nothing to compare."
        )
    errors, d = study.errors[:, CARRIER], study.difficulty[:, CARRIER]
    scores = {"d": errors.sum(axis=1), **dict(zip(CHANNELS, errors.T, strict=True))}
    scores["load"], scores["latent"] = study.features.one_sided[:, CARRIER], study.latent[:, CARRIER]
    scores["rms_torque"] = study.rms_torque[:, CARRIER]
    cool_error, hot_error = errors[~hot].mean(axis=0), errors[hot].mean(axis=0)
    return HotAndCool(
        cool_windows=int((~hot).sum()),
        hot_windows=int(hot.sum()),
        cool_error=cool_error,
        hot_error=hot_error,
        ratio=float(hot_error.sum() / cool_error.sum()),
        cool_difficulty=float(np.median(d[~hot])),
        hot_difficulty=float(np.median(d[hot])),
        ranking=ranking(hot, scores),
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
