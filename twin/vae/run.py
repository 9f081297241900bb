"""One training of several networks side by side, which can stop and continue."""

from collections.abc import Callable, Sequence
from copy import copy, deepcopy

import torch
from torch import Tensor

from twin.vae.config import TwinConfig
from twin.vae.loss import active_units, kl, negative_elbo, reconstruction
from twin.vae.model import build
from twin.vae.side_by_side import SideBySide
from twin.vae.twin import Fit


class Run:
    """Networks that are trained together; each ends with the weights of a training alone, but for rounding."""

    def __init__(self, x: Sequence[Tensor], noise: Tensor, config: TwinConfig, seeds: Sequence[int]) -> None:
        """
        Args:
            x: Windows of each network in z-scores, [time, channel, batch]; the same number for all.
            noise: Standard deviation added to each channel, in z-scores, [net, channel].
            seeds: Of each network.
        """
        self.x, self.noise, self.config, self.seeds = list(x), noise, config, list(seeds)
        self.elbo_by_epoch: list[Tensor] = []
        self.kl_by_epoch: list[Tensor] = []
        self.nets = SideBySide.of([build(config, seed, channels=x[0].shape[1]) for seed in seeds], config)
        self._draws = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._optimise()

    def _optimise(self) -> None:
        config, parameters = self.config, self.nets.parameters
        if config.optimizer == "sgd":
            self._optimizer = torch.optim.SGD(parameters, lr=config.learning_rate)
            self._schedule = None
            return
        self._optimizer = torch.optim.Adam(parameters, lr=config.learning_rate, fused=True)
        steps = max(config.epochs * -(-self.windows // config.batch), 2)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(self._optimizer, config.learning_rate, total_steps=steps)

    @property
    def windows(self) -> int:
        """Training windows of each network."""
        return self.x[0].shape[2]

    def select(self, chosen: Sequence[int]) -> "Run":
        """The same training of some of the networks from here on; this one is unchanged."""
        run, index = copy(self), list(chosen)
        run.x, run.noise, run.seeds = [self.x[n] for n in index], self.noise[index], [self.seeds[n] for n in index]
        run.elbo_by_epoch = [values[index] for values in self.elbo_by_epoch]
        run.kl_by_epoch = [values[index] for values in self.kl_by_epoch]
        run.nets = SideBySide(self.config, {name: w.detach()[index] for name, w in self.nets.weights.items()})
        run._draws = [torch.Generator() for _ in index]
        for draw, n in zip(run._draws, index, strict=True):
            draw.set_state(self._draws[n].get_state())
        run._optimise()
        state = deepcopy(self._optimizer.state_dict())
        for values in state["state"].values():
            values.update({name: value[index] for name, value in values.items() if name.startswith("exp_avg")})
        run._optimizer.load_state_dict(state)
        if run._schedule is not None and self._schedule is not None:
            run._schedule.load_state_dict(self._schedule.state_dict())
        return run

    def train(self, until: int, report: Callable[[], None] = lambda: None) -> None:
        """Train until this number of epochs; `report` is called after each."""
        while len(self.elbo_by_epoch) < until:
            orders = [torch.randperm(self.windows, generator=draw).split(self.config.batch) for draw in self._draws]
            sums = torch.zeros(2, len(self.x))
            for chosen in zip(*orders, strict=True):
                sums += len(chosen[0]) * self._step(chosen)
            elbo, nats = sums / self.windows
            self.elbo_by_epoch.append(elbo)
            self.kl_by_epoch.append(nats)
            report()

    def _step(self, chosen: Sequence[Tensor]) -> Tensor:
        """One step of the optimiser with these windows of each network; objective and KL, [2, net]."""
        config, variational = self.config, self.config.kind == "vae"
        steps, channels, _ = self.x[0].shape
        size = len(chosen[0])
        batch, eps = torch.empty(steps, len(self.x), channels, size), torch.empty(len(self.x), config.latent, size)
        for n, draw in enumerate(self._draws):
            torch.randn(eps[n].shape, generator=draw, out=eps[n])
            noise = torch.randn(steps, channels, size, generator=draw)
            batch[:, n] = noise.mul_(self.noise[n, :, None]).add_(self.x[n][:, :, chosen[n]])
        self._optimizer.zero_grad()
        x_hat, mu, logvar = self.nets(batch, eps)
        loss = negative_elbo(batch, x_hat, mu, logvar, config.beta if variational else 0.0, config.loss)
        loss.sum().backward()
        self._clip()
        self._optimizer.step()
        if self._schedule is not None:
            self._schedule.step()
        nats = kl(mu.detach(), logvar.detach()).mean(1) if variational else torch.zeros(len(self.x))
        return torch.stack([-loss.detach(), nats])

    def _clip(self) -> None:
        """Shorten the gradient of each network whose norm is larger than `config.clip`."""
        gradients = [parameter.grad for parameter in self.nets.parameters if parameter.grad is not None]
        squares = torch.stack([gradient.flatten(1).square().sum(1) for gradient in gradients]).sum(0)
        scale = (self.config.clip / (squares.sqrt() + 1e-6)).clamp(max=1.0)
        for gradient in gradients:
            gradient.mul_(scale.view(-1, *(1,) * (gradient.ndim - 1)))

    def elbos(self) -> list[float]:
        """Nats per window of each network on its training windows, with one draw of the latent for each window."""
        latent = self.config.latent
        draws = [torch.randn(latent, self.windows, generator=torch.Generator().manual_seed(s)) for s in self.seeds]
        eps, beta = torch.stack(draws), 1.0 if self.config.kind == "vae" else 0.0
        total = torch.zeros(len(self.x))
        with torch.no_grad():
            for some, batch in self._parts():
                total += batch.shape[-1] * -negative_elbo(batch, *self.nets(batch, eps[:, :, some]), beta)
        return (total / self.windows).tolist()

    def fits(self, restarts: Sequence[int], restart_elbos: Sequence[tuple[float | None, ...]]) -> list[Fit]:
        """Quality of each network on its training windows; arguments as in `Fit`, [net]."""
        means, nats, error = [], torch.zeros(len(self.x)), torch.zeros(len(self.x))
        variational = self.config.kind == "vae"
        with torch.no_grad():
            for _, batch in self._parts():
                mu, logvar = self.nets.encode(batch)
                means.append(mu)
                nats += kl(mu, logvar).sum(1) if variational else 0.0
                error += 2.0 * reconstruction(batch, self.nets.decode(mu, len(batch)), "mean").sum(1)
        mu, elbos = torch.cat(means, dim=2), self.elbos()
        return [
            Fit(
                elbo=elbos[n],
                kl=float(nats[n]) / self.windows,
                active_units=active_units(mu[n]),
                mean_squared_error=float(error[n]) / self.windows,
                restart=restarts[n],
                restart_elbos=restart_elbos[n],
                elbo_by_epoch=tuple(float(values[n]) for values in self.elbo_by_epoch),
                kl_by_epoch=tuple(float(values[n]) for values in self.kl_by_epoch),
            )
            for n in range(len(self.x))
        ]

    def _parts(self) -> list[tuple[slice, Tensor]]:
        """All windows, batch by batch: which, and [time, net, channel, batch]."""
        cuts = [slice(first, first + self.config.batch) for first in range(0, self.windows, self.config.batch)]
        return [(some, torch.stack([x[:, :, some] for x in self.x], dim=1)) for some in cuts]
