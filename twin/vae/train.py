"""Train the twins of arms on motion that stayed cool.

The networks of all joints and restarts, and of several arms, are trained side by side (`twin.vae.side_by_side`).

All restarts run the same schedule for a trial; only the one with the best ELBO on the training windows continues, so
two cost 1.6 trainings. A shorter trial ranks them worse: of four pairs of trainings on the quickstart's cool motion
(joints 2 and 4) the later winner led in 4 at epoch 36 of 60, in 2 at epoch 30. Held-out windows would cost data and
gave the same winner over five trainings of joint 2.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch
from torch import Tensor

from fleet.errors import FleetError
from fleet.robot import JOINTS
from fleet.seeding import child
from twin.vae.config import TwinConfig
from twin.vae.inference import Weights
from twin.vae.loss import collapsed
from twin.vae.model import one_thread
from twin.vae.run import Run
from twin.vae.training_key import hash_records, seed_text
from twin.vae.twin import Fit, Twin, net_names
from twin.vae.window import Scaler, draw_windows, windows_of

Array = np.ndarray

SIDE_BY_SIDE = 14
"""Networks trained at a time: enough that Python's share is small, few enough for the cache; see
`benchmarks/bench_twin.py`."""


class CollapsedPosterior(FleetError):
    """The decoder of a network ignores the latent and decodes every window alike."""


class Diverged(FleetError):
    """No training of a network ended with finite weights."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """Training data of the twin of one arm."""

    arm: str
    records: Sequence[Array]
    """Profiles [time, 3, joint] at `config.record_hz`. The phases of a plan, given one by one, are cut and padded as
    they will be when scored."""
    seed: np.random.SeedSequence
    data_hash: str | None = None
    """Name of the data in the checkpoint; by default the hash of the records."""


def train(
    records: Sequence[Array],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    *,
    arm: str,
    data_hash: str | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Twin:
    """A twin trained on motion of an arm that stayed cool for the whole horizon; arguments and errors as `train_all`.

    Uses one thread and no global random state, so the result is the same in any process.
    """
    return train_all([Motion(arm=arm, records=records, seed=seed, data_hash=data_hash)], config, progress=progress)[0]


def train_all(
    motions: Sequence[Motion], config: TwinConfig, *, progress: Callable[[float], None] = lambda share: None
) -> list[Twin]:
    """A twin for each motion, trained side by side; each is what a training alone gives, but for rounding.

    Args:
        progress: Called with the share done, 0 to 1, after every epoch.

    Raises:
        ValueError: no records, or one that is misshapen or not finite.
        CollapsedPosterior: the latent of a network is unused although its joints moved in training.
        Diverged: no training of a network ended with finite weights.
    """
    at_once = max(1, SIDE_BY_SIDE // (config.networks(JOINTS) * config.restarts))
    blocks = [motions[first : first + at_once] for first in range(0, len(motions), at_once)]
    twins: list[Twin] = []
    with one_thread():
        for done, block in enumerate(blocks):
            arms = [_Arm(motion, config) for motion in block]
            _train_block(arms, config, lambda share, done=done: progress((done + share) / len(blocks)))
            twins += [arm.twin() for arm in arms]
    return twins


class _Arm:
    """The windows of an arm, and its networks as they are trained."""

    def __init__(self, motion: Motion, config: TwinConfig) -> None:
        self.motion, self.config = motion, config
        windows = windows_of(motion.records, config)
        draw = np.random.SeedSequence(_child(motion.seed, windows.shape[2], 0))
        windows = draw_windows(windows, config.max_windows, draw)
        self.scaler = Scaler.fit(windows)
        self.names = net_names(config, self.scaler.joints)
        noise = (np.array(config.noise) / self.scaler.std).astype(np.float32)
        self.noise = torch.from_numpy(noise.reshape(len(self.names), -1))  # [net, channel]
        z = torch.from_numpy(self.scaler.to_z(windows)).flatten(2)  # [batch, time, channel]
        self.x = [part.permute(1, 2, 0).contiguous() for part in z.chunk(len(self.names), dim=2)]
        self.results: list[tuple[Fit, Weights] | None] = [None] * len(self.names)

    def twin(self) -> Twin:
        """The trained twin; raises as `train_all`."""
        still = [bool(part.all()) for part in np.split(self.scaler.still, len(self.names))]
        nets, fits = [], []
        for name, result, is_still in zip(self.names, self.results, still, strict=True):
            label = "the whole arm" if name == "arm" else name.replace("_", " ")
            if result is None:
                raise Diverged(
                    f"The training of {label} of '{self.motion.arm}' ended without finite weights. Lower "
                    "learning_rate or clip."
                )
            fit, weights = result
            kl_nats = fit.kl if self.config.kind == "vae" else None
            if collapsed(kl_nats, fit.active_units) and not (self.config.allow_collapse or is_still):
                raise CollapsedPosterior(
                    f"Posterior collapse of {label} in the twin of '{self.motion.arm}': KL {fit.kl:.2f} nat, "
                    f"{fit.active_units} active latent unit(s). Lower beta, train longer (epochs, max_windows), or set "
                    "allow_collapse to keep it as a baseline."
                )
            nets.append(weights)
            fits.append(fit)
        motion = self.motion
        data = hash_records(motion.records) if motion.data_hash is None else motion.data_hash
        seed = seed_text(motion.seed)
        return Twin(self.config, self.scaler, nets, arm=motion.arm, data_hash=data, seed=seed, fits=tuple(fits))


def _train_block(arms: Sequence[_Arm], config: TwinConfig, progress: Callable[[float], None]) -> None:
    """Train all networks of some arms; those with equally many windows side by side."""
    by_windows: dict[int, list[tuple[_Arm, int]]] = {}
    for arm in arms:
        for n, x in enumerate(arm.x):
            by_windows.setdefault(x.shape[2], []).append((arm, n))
    epochs, done = len(by_windows) * config.epochs, count(1)

    def report() -> None:
        progress(min(next(done) / epochs, 1.0))  # a diverged restart costs more epochs

    for nets in by_windows.values():
        noise = torch.stack([arm.noise[n] for arm, n in nets])
        seeds = [[_child(arm.motion.seed, n, restart) for restart in range(config.restarts)] for arm, n in nets]
        best = _best_of([arm.x[n] for arm, n in nets], noise, config, seeds, report)
        for (arm, n), result in zip(nets, best, strict=True):
            arm.results[n] = result


def _trial_epochs(config: TwinConfig) -> int:
    return max(1, round(config.trial * config.epochs)) if config.restarts > 1 else 0


def _best_of(
    x: Sequence[Tensor],
    noise: Tensor,
    config: TwinConfig,
    seeds: Sequence[Sequence[int]],
    report: Callable[[], None],
) -> list[tuple[Fit, Weights] | None]:
    """For each network its best restart after the trial, trained to the end; the next one if it diverges.

    Args:
        seeds: [net][restart].

    Returns:
        Fit and weights of each network; None where all restarts diverge.
    """
    restarts, trial = config.restarts, _trial_epochs(config)
    every = [(n, restart) for n in range(len(x)) for restart in range(restarts)]
    run = Run([x[n] for n, _ in every], noise[[n for n, _ in every]], config, [seeds[n][r] for n, r in every])
    run.train(trial, report)
    elbos = np.reshape(run.elbos(), (len(x), restarts)) if trial else np.zeros((len(x), 1))
    order = np.argsort(np.where(np.isfinite(elbos), -elbos, np.inf), axis=1, kind="stable")
    compared = [tuple(float(v) if math.isfinite(v) else None for v in row) if trial else () for row in elbos]
    results: list[tuple[Fit, Weights] | None] = [None] * len(x)
    pending = list(range(len(x)))
    for kept in order.T:
        chosen = [n * restarts + int(kept[n]) for n in pending]
        last = run.select(chosen) if trial else run
        last.train(config.epochs, report)
        fits = last.fits([int(kept[n]) for n in pending], [compared[n] for n in pending])
        for i, n in enumerate(pending):
            if math.isfinite(fits[i].elbo):
                results[n] = fits[i], last.nets.weights_of(i)
        pending = [n for n in pending if results[n] is None]
        if not pending:
            break
    return results


def _child(seed: np.random.SeedSequence, joint: int, restart: int) -> int:
    """A seed for torch."""
    return int(child(seed, joint, restart).generate_state(1, np.uint64)[0] >> np.uint64(1))
