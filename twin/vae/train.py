"""Train the twin of one arm on motion that stayed cool.

All restarts run the same schedule for a trial; only the one with the best ELBO on the training windows continues, so
two cost 1.6 trainings. A shorter trial ranks them worse: of four pairs of trainings on the quickstart's cool motion
(joints 2 and 4) the later winner led in 4 at epoch 36 of 60, in 2 at epoch 30. Held-out windows would cost data and
gave the same winner over five trainings of joint 2.
"""

import math
from collections.abc import Callable, Sequence
from itertools import count

import numpy as np
import torch
from torch import Tensor

from fleet.errors import FleetError
from fleet.seeding import child
from twin.vae.config import TwinConfig
from twin.vae.loss import active_units, collapsed, kl, negative_elbo
from twin.vae.model import LstmVae, build, one_thread, weights_of
from twin.vae.training_key import hash_records, seed_text
from twin.vae.twin import Fit, Twin, net_names
from twin.vae.window import Scaler, draw_windows, windows_of

Array = np.ndarray


class CollapsedPosterior(FleetError):
    """The decoder of a network ignores the latent and decodes every window alike."""


class Diverged(FleetError):
    """No training of a network ended with finite weights."""


def train(
    records: Sequence[Array],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    *,
    arm: str,
    data_hash: str | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Twin:
    """A twin trained on motion of an arm that stayed cool for the whole horizon.

    Uses one thread and no global random state, so the result is the same in any process; train several arms in
    processes of their own.

    Args:
        records: Profiles [time, 3, joint] at `config.record_hz`. The phases of a plan, given one by one, are cut and
            padded as they will be when scored.
        data_hash: Name of the data in the checkpoint; by default the hash of the records.
        progress: Called with the share done, 0 to 1, after every epoch.

    Raises:
        ValueError: no records, or one that is misshapen or not finite.
        CollapsedPosterior: the latent of a network is unused although its joints moved in training.
        Diverged: no training of a network ended with finite weights.
    """
    windows = windows_of(records, config)
    windows = draw_windows(windows, config.max_windows, np.random.SeedSequence(_child(seed, windows.shape[2], 0)))
    scaler = Scaler.fit(windows)
    names = net_names(config, scaler.joints)
    noise = (np.array(config.noise) / scaler.std).astype(np.float32).reshape(len(names), -1)  # [net, channel]
    still = [bool(part.all()) for part in np.split(scaler.still, len(names))]
    nets, fits = [], []
    z = torch.from_numpy(scaler.to_z(windows)).flatten(2)
    epochs = len(names) * (config.epochs + (config.restarts - 1) * _trial_epochs(config))
    done = count(1)

    def report() -> None:
        progress(min(next(done) / epochs, 1.0))  # a diverged restart costs more epochs

    with one_thread():
        for n, (name, x) in enumerate(zip(names, z.chunk(len(names), dim=2), strict=True)):
            seeds = [_child(seed, n, restart) for restart in range(config.restarts)]
            best = _best_of(x.contiguous(), torch.from_numpy(noise[n]), config, seeds, report)
            label = "the whole arm" if name == "arm" else name.replace("_", " ")
            if best is None:
                raise Diverged(
                    f"The training of {label} of '{arm}' ended without finite weights. Lower learning_rate or clip."
                )
            fit, net = best
            kl_nats = fit.kl if config.kind == "vae" else None
            if collapsed(kl_nats, fit.active_units) and not (config.allow_collapse or still[n]):
                raise CollapsedPosterior(
                    f"Posterior collapse of {label} in the twin of '{arm}': KL {fit.kl:.2f} nat, {fit.active_units} "
                    "active latent unit(s). Lower beta, train longer (epochs, max_windows), or set allow_collapse to "
                    "keep it as a baseline."
                )
            nets.append(weights_of(net))
            fits.append(fit)
    data = hash_records(records) if data_hash is None else data_hash
    return Twin(config, scaler, nets, arm=arm, data_hash=data, seed=seed_text(seed), fits=tuple(fits))


def _trial_epochs(config: TwinConfig) -> int:
    return max(1, round(config.trial * config.epochs)) if config.restarts > 1 else 0


def _best_of(
    x: Tensor, noise: Tensor, config: TwinConfig, seeds: Sequence[int], report: Callable[[], None]
) -> tuple[Fit, LstmVae] | None:
    """The best restart after the trial, trained to the end; the next one if it diverges, None if all do."""
    runs = [Run(x, noise, config, seed) for seed in seeds]
    trial = _trial_epochs(config)
    for run in runs:
        run.train(trial, report)
    elbos = [_elbo(run, seed) for run, seed in zip(runs, seeds, strict=True)]
    finite = tuple(elbo if math.isfinite(elbo) else None for elbo in elbos) if trial else ()
    for n in sorted(range(len(runs)), key=lambda n: -elbos[n] if math.isfinite(elbos[n]) else math.inf):
        runs[n].train(config.epochs, report)
        if math.isfinite(_elbo(runs[n], seeds[n])):
            return _assess(runs[n], seeds[n], n, finite), runs[n].net
    return None


class Run:
    """One training of one network, which can stop and continue."""

    def __init__(self, x: Tensor, noise: Tensor, config: TwinConfig, seed: int) -> None:
        """
        Args:
            x: Windows in z-scores, [batch, time, channel].
            noise: Standard deviation added to each channel, in z-scores, [channel].
        """
        self.x, self.noise, self.config = x, noise, config
        self.net = build(config, seed, channels=x.shape[-1])
        self.elbo_by_epoch: list[float] = []
        self.kl_by_epoch: list[float] = []
        self._draw = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.Adam(self.net.parameters(), lr=config.learning_rate, fused=True)
        steps = max(config.epochs * -(-len(x) // config.batch), 2)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(self._optimizer, config.learning_rate, total_steps=steps)

    def train(self, until: int, report: Callable[[], None] = lambda: None) -> None:
        """Train until this number of epochs; `report` is called after each."""
        while len(self.elbo_by_epoch) < until:
            sums = torch.zeros(2)
            for index in torch.randperm(len(self.x), generator=self._draw).split(self.config.batch):
                sums += len(index) * self._step(self.x[index])
            elbo, nats = (sums / len(self.x)).tolist()
            self.elbo_by_epoch.append(elbo)
            self.kl_by_epoch.append(nats)
            report()

    def _step(self, batch: Tensor) -> Tensor:
        """One step of the optimiser; ELBO and KL of the batch, nats per window."""
        config, net, draw = self.config, self.net, self._draw
        variational = config.kind == "vae"
        batch = batch + self.noise * torch.randn(batch.shape, generator=draw)
        eps = torch.randn(len(batch), config.latent, generator=draw)
        self._optimizer.zero_grad()
        x_hat, mu, logvar = net(batch, eps)
        loss = negative_elbo(batch, x_hat, mu, logvar, config.beta if variational else 0.0)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip)
        self._optimizer.step()
        self._schedule.step()
        nats = kl(mu.detach(), logvar.detach()).mean() if variational else torch.zeros(())
        return torch.stack([-loss.detach(), nats])


def _elbo(run: Run, seed: int) -> float:
    """Nats per window on the training windows, with one draw of the latent for each."""
    draw = torch.Generator().manual_seed(seed)
    with torch.inference_mode():
        x_hat, mu, logvar = run.net(run.x, torch.randn(len(run.x), run.config.latent, generator=draw))
        return -float(negative_elbo(run.x, x_hat, mu, logvar, 1.0 if run.config.kind == "vae" else 0.0))


def _assess(run: Run, seed: int, restart: int, restart_elbos: tuple[float | None, ...]) -> Fit:
    """Quality on the training windows."""
    with torch.inference_mode():
        mu, logvar = run.net.encode(run.x)
        mean_hat = run.net.decode(mu, run.x.shape[1])
        return Fit(
            elbo=_elbo(run, seed),
            kl=float(kl(mu, logvar).mean()) if run.config.kind == "vae" else 0.0,
            active_units=active_units(mu),
            mean_squared_error=float((run.x - mean_hat).square().mean()),
            restart=restart,
            restart_elbos=restart_elbos,
            elbo_by_epoch=tuple(run.elbo_by_epoch),
            kl_by_epoch=tuple(run.kl_by_epoch),
        )


def _child(seed: np.random.SeedSequence, joint: int, restart: int) -> int:
    """A seed for torch."""
    return int(child(seed, joint, restart).generate_state(1, np.uint64)[0] >> np.uint64(1))
