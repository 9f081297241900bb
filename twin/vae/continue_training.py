"""Train the networks of one twin further, on other motion: of the same arm later, or of another arm."""

from collections.abc import Sequence

import numpy as np
import torch

from fleet.seeding import child
from twin.vae.config import TwinConfig
from twin.vae.model import one_thread
from twin.vae.run import Run
from twin.vae.training_key import hash_records, seed_text
from twin.vae.twin import Twin
from twin.vae.window import Scaler, draw_windows, windows_of

Array = np.ndarray

SHAPE = ("scope", "kind", "latent", "hidden", "layers", "window", "rate_hz")
"""Fields of the configuration that must equal those of the first twin."""


def continue_training(
    start: Twin, records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence, *, arm: str
) -> Twin:
    """A twin of `arm` whose networks start from the weights of another twin; its z-scores are those of the records.

    It uses one thread and no global random state. There are no restarts, since the weights are given, and the twin is
    not calibrated.

    Args:
        start: The first twin; it is unchanged.
        records: Cool motion of the arm, profiles [time, 3, joint] at `config.record_hz`.
        config: Epochs, batch and learning rate of the further training.

    Raises:
        ValueError: records as in `twin.vae.train.train`, another number of joints, or a configuration with networks
            of another shape.
    """
    if differing := [name for name in SHAPE if getattr(config, name) != getattr(start.config, name)]:
        raise ValueError(f"The configuration differs from that of the first twin in {', '.join(differing)}.")
    windows = windows_of(records, config)
    if windows.shape[2] != start.joints:
        raise ValueError(f"The first twin has {start.joints} joints, the records have {windows.shape[2]}.")
    windows = draw_windows(windows, config.max_windows, child(seed, 0))
    scaler, count = Scaler.fit(windows), len(start.nets)
    noise = torch.from_numpy((np.array(config.noise) / scaler.std).astype(np.float32)).reshape(count, -1)
    parts = torch.from_numpy(scaler.to_z(windows)).flatten(2).chunk(count, dim=2)
    seeds = [int(child(seed, 1, n).generate_state(1)[0]) for n in range(count)]
    with one_thread():
        run = Run([part.permute(1, 2, 0).contiguous() for part in parts], noise, config, seeds)
        with torch.no_grad():
            for name, weight in run.nets.weights.items():
                weight.copy_(torch.from_numpy(np.stack([net[name] for net in start.nets])))
        run.train(config.epochs)
        fits = run.fits([0] * count, [()] * count)
    nets = [run.nets.weights_of(n) for n in range(count)]
    return Twin(config, scaler, nets, arm=arm, data_hash=hash_records(records), seed=seed_text(seed), fits=tuple(fits))
