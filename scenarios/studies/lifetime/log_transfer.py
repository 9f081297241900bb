"""The twin of a simulated arm as the start for a real arm, whose logs are given: the data that this saves."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleet.errors import FleetError
from fleet.seeding import child
from scenarios.prepare.simulated_logs import own_logs
from scenarios.progress import Progress, quiet
from scenarios.studies.lifetime.arm_transfer import Cell, TransferSize, compare_starts, with_steps
from scenarios.studies.ranking import CARRIER
from scenarios.studies.real_logs import CONFIG, HOT_C
from scenarios.studies.setup import make_study
from twin.logs.recording import Recording
from twin.logs.resampling import stretches
from twin.training_data import cool_stretches
from twin.vae.train import train
from twin.vae.window import windows_of

Array = np.ndarray

FILES = (1, 2, 4, 8, 16)
LEAST_HELD_OUT = 8
"""Fewest cool files to judge on."""
WORK_S, REST_S = 150.0, 30.0
"""Simulated log of each job of the first arm."""


def log_transfer(
    recordings: Sequence[Recording], seeds: Sequence[int], size: TransferSize, *, progress: Progress = quiet
) -> tuple[Cell, ...]:
    """As `arm_transfer`, with a real second arm: `Trained.jobs` counts files, and AUROC is NaN.

    Files are cool if joint 2 never reaches `HOT_C`. Each seed draws those that are trained on; the other cool files
    are held out.

    Raises:
        FleetError: too few files are cool.
    """
    own = {name: getattr(CONFIG, name) for name in ("rate_hz", "record_hz", "window", "stride")}
    config = size.config.changed(**own)
    size = replace(size, config=config)
    cool = [r for r in recordings if r.temp_c is not None and r.temp_c[:, CARRIER].max(initial=-np.inf) < HOT_C]
    parts = [
        [
            part.profile
            for part in cool_stretches([r], config.rate_hz, cool_c=HOT_C, horizon_s=np.inf, joints=(CARRIER,))
        ]
        for r in cool
    ]
    parts = [some for some in parts if any(len(profile) >= config.window for profile in some)]
    least = FILES[-1] + LEAST_HELD_OUT
    if len(parts) < least:
        raise FleetError(
            f"{len(parts)} of {len(recordings)} logs stay below {HOT_C:g} °C on joint {CARRIER + 1} and last "
            f"{config.window / config.rate_hz:g} s: the study needs {least}; add logs of light work."
        )
    cells = []
    for seed in seeds:
        progress("transfer", len(cells) / len(seeds))
        root = np.random.SeedSequence(seed)
        first = make_study(child(root, 0), train=size.source_jobs, reference=0, test=0, novel=0)
        logs = own_logs(
            first.hardware,
            first.train.plans,
            np.random.default_rng(child(root, 1)),
            ambient_c=first.ambient_c,
            work_s=WORK_S,
            rest_s=REST_S,
        )
        own = [part.profile for log in logs for part in stretches(log, config.rate_hz)]
        source = train(own, with_steps(size.config, own, size.source_steps), child(root, 2), arm="simulated")
        order = np.random.default_rng(child(root, 3)).permutation(len(parts))
        chosen = {n: [record for i in order[:n] for record in parts[i]] for n in FILES}
        held_out = windows_of([record for i in order[FILES[-1] :] for record in parts[i]], size.config)
        cells.append(
            compare_starts("real arm", seed, source, chosen, held_out, size, child(root, 4), lambda _: float("nan"))
        )
    return tuple(cells)
