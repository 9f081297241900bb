"""Features of recordings under a twin, window by window and as a mean over the recording."""

import numpy as np

from fleet.errors import FleetError
from twin.logs.recording import Recording
from twin.logs.resampling import Stretch, stretches
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray


def log_windows(twin: Twin, recording: Recording) -> list[tuple[Stretch, Array, Features]]:
    """Each stretch without gaps with the first samples of its windows, which do not overlap, and their features.

    Raises:
        FleetError: the recording has another number of joints than the twin, or no stretch of one window.
    """
    if recording.joints != twin.joints:
        raise FleetError(f"'{recording.name}' has {recording.joints} joints, the twin of '{twin.arm}' {twin.joints}.")
    config, parts = twin.config, list[tuple[Stretch, Array, Features]]()
    for stretch in stretches(recording, config.rate_hz):
        first = np.arange(0, len(stretch.profile) - config.window + 1, config.window)
        if len(first):
            inside = first[:, None] + np.arange(config.window)
            windows = stretch.profile[inside].transpose(0, 1, 3, 2)
            parts.append((stretch, first, twin.window_features(windows)))
    if not parts:
        raise FleetError(
            f"'{recording.name}' has no stretch of {config.window / config.rate_hz:g} s without a gap, which one "
            "window needs."
        )
    return parts


def log_features(twin: Twin, recording: Recording) -> Features:
    """Mean features of a recording over its windows, [joint]; raises as `log_windows`."""
    parts = [features.packed for _, _, features in log_windows(twin, recording)]
    return Features(np.concatenate(parts).mean(axis=0))
