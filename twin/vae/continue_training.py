"""Train the networks of one twin further on the motion of another arm."""

from collections.abc import Sequence

import numpy as np
import torch

from fleet.seeding import child
from twin.vae.config import TwinConfig
from twin.vae.loss import active_units, kl, negative_elbo
from twin.vae.model import LstmVae, build, one_thread, weights_of
from twin.vae.training_key import hash_records, seed_text
from twin.vae.twin import Fit, Twin
from twin.vae.window import Scaler, draw_windows, windows_of

Array = np.ndarray

SHAPE = ("scope", "kind", "latent", "hidden", "layers", "window", "rate_hz")
"""Fields of the configuration that must equal those of the first twin."""


def continue_training(
    start: Twin,
    records: Sequence[Array],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    *,
    arm: str,
    scaler: Scaler | None = None,
) -> Twin:
    """A twin of `arm` whose networks start from the weights of another twin, instead of random ones.

    Uses one thread and no global random state. There are no restarts, since the weights are given.

    Args:
        start: The first twin; it is unchanged.
        records: Cool motion of the arm, profiles [time, 3, joint] at `config.record_hz`.
        config: Epochs, batch, learning rate and β of the further training.
        scaler: z-scores; default: fitted on the records.

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
    scaler = scaler or Scaler.fit(windows)
    z = torch.from_numpy(scaler.to_z(windows)).flatten(2).chunk(len(start.nets), dim=2)
    noise = torch.from_numpy((np.array(config.noise) / scaler.std).astype(np.float32)).reshape(len(start.nets), -1)
    nets, fits = [], []
    with one_thread():
        for n, (weights, x) in enumerate(zip(start.nets, z, strict=True)):
            net = build(config, 0, channels=x.shape[-1])
            net.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})
            draw = torch.Generator().manual_seed(int(child(seed, 1, n).generate_state(1)[0]))
            fits.append(_train(net, x.contiguous(), noise[n], config, draw))
            nets.append(weights_of(net))
    return Twin(
        config, scaler, nets, arm=arm, data_hash=hash_records(records), seed=seed_text(seed), fits=tuple(fits)
    )


def _train(net: LstmVae, x: torch.Tensor, noise: torch.Tensor, config: TwinConfig, draw: torch.Generator) -> Fit:
    optimizer = torch.optim.Adam(net.parameters(), lr=config.learning_rate, fused=True)
    steps = max(config.epochs * -(-len(x) // config.batch), 2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=steps)
    beta = config.beta if config.kind == "vae" else 0.0
    for _ in range(config.epochs):
        for index in torch.randperm(len(x), generator=draw).split(config.batch):
            batch = x[index] + noise * torch.randn(x[index].shape, generator=draw)
            optimizer.zero_grad()
            eps = torch.randn(len(batch), config.latent, generator=draw)
            x_hat, mu, logvar = net(batch, eps)
            negative_elbo(batch, x_hat, mu, logvar, beta).backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip)
            optimizer.step()
            schedule.step()
    with torch.inference_mode():
        mu, logvar = net.encode(x)
        mean_hat = net.decode(mu, x.shape[1])
        return Fit(
            elbo=-float(negative_elbo(x, mean_hat, mu, logvar, beta)),
            kl=float(kl(mu, logvar).mean()) if beta else 0.0,
            active_units=active_units(mu),
            mean_squared_error=float((x - mean_hat).square().mean()),
            restart=0,
        )
