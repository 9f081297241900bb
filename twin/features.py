"""Windows in a few plain numbers per joint: what classical detectors and regressors read instead of samples."""

import numpy as np

from fleet.motion import CHANNELS

Array = np.ndarray

STATISTICS = ("mean", "std", "rms", "min", "max", "step")
"""Per channel over the window's time; `step` is the mean absolute difference from one sample to the next."""
FEATURES = tuple(f"{statistic}_{channel}" for statistic in STATISTICS for channel in CHANNELS)


def window_features(windows: Array) -> Array:
    """The 18 `FEATURES` of each joint, [batch, joint, feature], of windows [batch, time, joint, channel].

    Raises:
        ValueError: windows of another shape, or of fewer than two samples.
    """
    if windows.ndim != 4 or windows.shape[1] < 2 or windows.shape[3] != len(CHANNELS):
        raise ValueError(f"Windows must be [batch, time >= 2, joint, {len(CHANNELS)}] (got {windows.shape}).")
    x = np.asarray(windows, dtype=float)
    found = (
        x.mean(axis=1),
        x.std(axis=1),
        np.sqrt(np.square(x).mean(axis=1)),
        x.min(axis=1),
        x.max(axis=1),
        np.abs(np.diff(x, axis=1)).mean(axis=1),
    )
    return np.concatenate(found, axis=-1)
