"""Training the twin of one arm from motion that stayed cool."""

import hashlib
import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
import torch
from torch import Tensor

from fleet.errors import FleetError
from twin.loss import active_units, collapsed, kl, negative_elbo, reconstruction
from twin.model import JointVae, TwinConfig, build, one_thread
from twin.score import JointFit, Twin
from twin.window import Scaler, windows_of

Array = np.ndarray

RECIPE = 1
"""Raised whenever the same records, configuration and seed would give other weights."""


class CollapsedPosterior(FleetError):
    """The latent of a joint carries nothing: the decoder answers every window with the same motion."""

    def __init__(self, arm: str, joint: int, kl_nats: float, active: int) -> None:
        super().__init__(
            f"The twin of '{arm}' learned nothing of joint {joint + 1}: KL {kl_nats:.2f} nat, {active} active latent "
            "unit(s). Lower beta, train longer (epochs, max_windows), or set allow_collapse to keep it as a baseline."
        )
        self.joint = joint


class Diverged(FleetError):
    """No training of a joint ended with finite weights."""

    def __init__(self, arm: str, joint: int) -> None:
        super().__init__(
            f"The training of joint {joint + 1} of '{arm}' ended without finite weights. Lower learning_rate or clip."
        )
        self.joint = joint


def hash_records(records: Sequence[Array]) -> str:
    """Name of the training data by its content."""
    digest = hashlib.sha256()
    for record in records:
        digest.update(f"{record.dtype}{record.shape}".encode())
        digest.update(np.ascontiguousarray(record).tobytes())
    return digest.hexdigest()[:32]


def training_key(records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence) -> str:
    """Equal keys mean equal weights: a stored twin may be used again while this stays the same."""
    parts = [str(RECIPE), hash_records(records), msgspec.json.encode(config).decode(), seed_text(seed)]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:32]


def seed_text(seed: np.random.SeedSequence) -> str:
    """A seed as text, `entropy/spawn.key`."""
    return f"{seed.entropy}/{'.'.join(map(str, seed.spawn_key))}"


def train(
    records: Sequence[Array],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    *,
    arm: str,
    data_hash: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Twin:
    """The twin of an arm that has moved like this and stayed cool for the whole horizon.

    Runs on one thread and touches no global random state, so the result is the same in any process; train arms side
    by side in processes of their own.

    Args:
        records: Profiles [time, 3, joint] at `config.record_hz`. Those of a plan's phases, one by one, are cut and
            padded as they will be when scored. Light, cool work makes the sharpest twin: what was trained on is known.
        data_hash: Name of the data in the checkpoint; by default the hash of the records.
        progress: Told the share done, 0 to 1, after every epoch.

    Raises:
        ValueError: no records, or one that is misshapen or not finite.
        CollapsedPosterior: a joint that did move in training has no latent to speak of.
        Diverged: the optimiser lost its way on some joint.
    """
    windows = windows_of(
        records, from_hz=config.record_hz, rate_hz=config.rate_hz, window=config.window, stride=config.stride
    )
    if len(windows) > config.max_windows:
        rng = np.random.default_rng(_child(seed, windows.shape[2], 0))
        windows = windows[np.sort(rng.choice(len(windows), config.max_windows, replace=False))]
    scaler = Scaler.fit(windows)
    z = torch.from_numpy(scaler.to_z(windows))
    noise = torch.from_numpy((np.array(config.noise) / scaler.std).astype(np.float32))  # [joint, channel]
    nets, fits = [], []
    runs = scaler.joints * config.restarts
    with one_thread():
        for joint in range(scaler.joints):
            x = z[:, :, joint].contiguous()
            candidates: list[tuple[JointFit, JointVae]] = []
            for restart in range(config.restarts):
                done = joint * config.restarts + restart
                report = None if progress is None else _part_of(progress, done, runs)
                own = _child(seed, joint, restart)
                net = fit_joint(x, noise[joint], config, own, progress=report)
                candidates.append((_assess(net, x, config, own, restart), net))
            candidates = [(fit, net) for fit, net in candidates if math.isfinite(fit.elbo)]
            if not candidates:
                raise Diverged(arm, joint)
            fit, net = max(candidates, key=lambda pair: pair[0].elbo)
            if collapsed(fit.kl, fit.active_units) and not (config.allow_collapse or scaler.still[joint]):
                raise CollapsedPosterior(arm, joint, fit.kl, fit.active_units)
            nets.append(net)
            fits.append(fit)
    data = hash_records(records) if data_hash is None else data_hash
    return Twin(config, scaler, nets, arm=arm, data_hash=data, seed=seed_text(seed), fits=fits)


def fit_joint(
    x: Tensor,
    noise: Tensor,
    config: TwinConfig,
    seed: int,
    *,
    progress: Callable[[float], None] | None = None,
) -> JointVae:
    """One training of one joint's network.

    Args:
        x: Windows in z-scores, [batch, time, channel].
        noise: Standard deviation added to each channel, in z-scores, [channel].
    """
    net = build(config, seed)
    draw = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(net.parameters(), lr=config.learning_rate, fused=True)
    steps = config.epochs * -(-len(x) // config.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=max(steps, 2))
    for epoch in range(config.epochs):
        for index in torch.randperm(len(x), generator=draw).split(config.batch):
            batch = x[index]
            batch = batch + noise * torch.randn(batch.shape, generator=draw)
            eps = torch.randn(len(index), config.latent, generator=draw)
            optimizer.zero_grad()
            x_hat, mu, logvar = net(batch, eps)
            negative_elbo(batch, x_hat, mu, logvar, config.beta).backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip)
            optimizer.step()
            schedule.step()
        if progress is not None:
            progress((epoch + 1) / config.epochs)
    return net


def _assess(net: JointVae, x: Tensor, config: TwinConfig, seed: int, restart: int) -> JointFit:
    """Quality on the training windows, with one draw of the latent per window for the ELBO."""
    draw = torch.Generator().manual_seed(seed)
    with torch.inference_mode():
        x_hat, mu, logvar = net(x, torch.randn(len(x), config.latent, generator=draw))
        mean_hat = net.decode(mu, x.shape[1])
        nats = kl(mu, logvar).mean()
        return JointFit(
            elbo=float(-(reconstruction(x, x_hat).mean() + nats)),
            kl=float(nats),
            active_units=active_units(mu),
            mean_squared_error=float((x - mean_hat).square().mean()),
            restart=restart,
        )


def _child(seed: np.random.SeedSequence, joint: int, restart: int) -> int:
    """A seed for torch. `SeedSequence.spawn` would count its calls, and the second training would differ."""
    own = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, joint, restart))
    return int(own.generate_state(1, np.uint64)[0] >> np.uint64(1))


def _part_of(progress: Callable[[float], None], done: int, runs: int) -> Callable[[float], None]:
    return lambda share: progress((done + share) / runs)
