"""Train the twin of an arm on motion that stayed cool.

The networks of all joints and restarts are trained side by side, with a network axis in front; a training can stop and
continue. Windows are [time, net, channel, batch]: with the batch last, each gate of a cell is
one block of memory. Between the matrix products, `twin.vae.inference.forward` computes a whole time step at once.
torch.nn.LSTM takes three times as long for windows this small (`benchmarks/bench_twin.py`), and `torch.vmap` does not
run it.

All restarts run the same schedule for a trial; only the one with the best ELBO on the training windows continues, so
two cost 1.6 trainings. A shorter trial ranks them worse: of four pairs of trainings on the quickstart's cool motion
(joints 2 and 4) the later winner led in 4 at epoch 36 of 60, in 2 at epoch 30. Held-out windows would cost data and
gave the same winner over five trainings of joint 2.
"""

import math
from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fleet.errors import FleetError
from fleet.seeding import child
from twin.vae import inference
from twin.vae.config import LOGVAR_RANGE, TwinConfig, hash_records, seed_text
from twin.vae.inference import Weights
from twin.vae.model import LstmVae, active_units, build, collapsed, kl, negative_elbo, one_thread, reconstruction
from twin.vae.twin import Fit, Twin, net_names
from twin.vae.window import Scaler, draw_windows, windows_of


class _Memory:
    """Arrays of one layer that the gradient needs, kept from step to step."""

    def __init__(self, steps: int, nets: int, inputs: int, hidden: int, batch: int) -> None:
        self.steps, self.nets, self.inputs, self.batch = steps, nets, inputs, batch
        self.states = torch.zeros(steps + 1, nets, inputs + hidden, batch)
        """Inputs of a step and hidden states before it: what the weights multiply."""
        self.cells = torch.zeros(steps + 1, nets, hidden, batch)
        self.gates = torch.empty(steps, nets, 4 * hidden, batch)
        self.of_gates, self.total = torch.empty_like(self.gates[0]), torch.empty_like(self.gates[0])
        self.of_states, self.of_cells = torch.empty_like(self.cells[0]), torch.empty_like(self.cells[0])
        self.order = np.arange(nets)
        self.flat_gates, self.flat_cells, self.flat_states = (
            [rows(step) for step in each] for each in (self.gates, self.cells, self.states)
        )

    @property
    def hidden_states(self) -> Tensor:
        """After each step, [time, net, hidden, batch]."""
        return self.states[1:, :, self.inputs :]


def rows(values: Tensor) -> np.ndarray:
    """A tensor [net, ...] as an array [net, size] of the same memory."""
    return values.numpy().reshape(len(values), -1)


class _Lstm(torch.autograd.Function):
    """One layer over all time steps."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor | None, driven: Tensor, weight: Tensor, memory: _Memory, last: bool) -> Tensor:
        """
        Args:
            inputs: [time, net, input, batch]; None if all input is in `driven`.
            driven: Bias and input that do not change with time, [net, 4 hidden, batch].
            weight: Of input and hidden state, [net, 4 hidden, input + hidden].
            last: Whether only the hidden state after the last step is wanted.

        Returns:
            Hidden states [time, net, hidden, batch], or the last [net, hidden, batch].
        """
        driven, weight = driven.detach().contiguous(), weight.detach()
        if inputs is not None:
            memory.states[:-1, :, : memory.inputs] = inputs.detach()
        advance, skip, flat = inference.forward.compiled, memory.inputs * memory.batch, rows(driven)
        cells, states = memory.flat_cells, memory.flat_states
        for t in range(memory.steps):
            torch.bmm(weight, memory.states[t], out=memory.gates[t])
            advance(memory.flat_gates[t], flat, cells[t], cells[t + 1], states[t + 1], skip, memory.order)
        ctx.save_for_backward(weight)
        ctx.memory, ctx.last, ctx.has_inputs = memory, last, inputs is not None
        return memory.hidden_states[-1].clone() if last else memory.hidden_states

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None, None]:
        (of_output,), (weight,), memory, last = grad_outputs, ctx.saved_tensors, ctx.memory, ctx.last
        recurrent = weight[:, :, memory.inputs :].transpose(1, 2).contiguous()
        onward, of_inputs = weight[:, :, : memory.inputs].transpose(1, 2).contiguous(), None
        if ctx.has_inputs and ctx.needs_input_grad[0]:
            of_inputs = torch.empty(memory.steps, memory.nets, memory.inputs, memory.batch)
        retreat, of_weight = inference.backward.compiled, torch.zeros_like(weight)
        flat = [rows(each) for each in (memory.of_states, memory.of_cells, memory.of_gates, memory.total)]
        memory.of_cells.zero_()
        memory.total.zero_()
        memory.of_states.copy_(of_output if last else of_output[-1])
        for t in range(memory.steps - 1, -1, -1):
            retreat(memory.flat_gates[t], memory.flat_cells[t], memory.flat_cells[t + 1], *flat, memory.order)
            of_weight.baddbmm_(memory.of_gates, memory.states[t].transpose(1, 2))
            if of_inputs is not None:
                torch.bmm(onward, memory.of_gates, out=of_inputs[t])
            if t and last:
                torch.bmm(recurrent, memory.of_gates, out=memory.of_states)
            elif t:
                torch.baddbmm(of_output[t - 1], recurrent, memory.of_gates, out=memory.of_states)
        return of_inputs, memory.total.clone(), of_weight, None, None


@dataclass(eq=False)
class SideBySide:
    """Networks of one configuration, [net, ...]; functions as those of `LstmVae`."""

    config: TwinConfig
    weights: dict[str, Tensor]
    """By the names of `LstmVae`, [net, ...]."""
    _memory: dict[tuple[str, int, int], _Memory] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, nets: Sequence[LstmVae], config: TwinConfig) -> "SideBySide":
        """The weights of networks of one shape."""
        states = [net.state_dict() for net in nets]
        return cls(config, {name: torch.stack([state[name] for state in states]) for name in states[0]})

    @cached_property
    def parameters(self) -> list[Tensor]:
        """The weights, for an optimiser."""
        return [weight.requires_grad_() for weight in self.weights.values()]

    def weights_of(self, n: int) -> dict[str, np.ndarray]:
        """A copy of the weights of one network by name, for `twin.vae.inference`."""
        return {name: weight[n].detach().numpy().copy() for name, weight in self.weights.items()}

    def encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Posterior mean and log variance, [net, latent, batch], of windows [time, net, channel, batch]."""
        summary = torch.tanh(self._linear("summary", self._lstm("encoder", x, len(x), last=True)))
        mu = self._linear("mu", summary)
        if "logvar.weight" not in self.weights:
            return mu, torch.full_like(mu, -torch.inf)
        return mu, self._linear("logvar", summary).clamp(*LOGVAR_RANGE)

    def decode(self, z: Tensor, steps: int) -> Tensor:
        """Windows [time, net, channel, batch] of latents [net, latent, batch]."""
        return self._linear("out", self._lstm("decoder", torch.tanh(self._linear("expand", z)), steps))

    def __call__(self, x: Tensor, eps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reconstruction from z = mu + eps·sigma with mean and log variance; eps = 0 decodes the mean."""
        mu, logvar = self.encode(x)
        return self.decode(mu + eps * torch.exp(0.5 * logvar), len(x)), mu, logvar

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return torch.matmul(self.weights[f"{name}.weight"], x) + self.weights[f"{name}.bias"][:, :, None]

    def _lstm(self, name: str, x: Tensor, steps: int, *, last: bool = False) -> Tensor:
        """Hidden states of the highest layer; x is [time, net, size, batch], or [net, size, batch] at every step."""
        layers = self.config.layers
        for layer in range(layers):
            of_input, recurrent, bias, bias_hh = (
                self.weights[f"{name}.{kind}_l{layer}"] for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
            )
            driven = (bias + bias_hh)[:, :, None].expand(-1, -1, x.shape[-1])
            constant = x.ndim == 3
            if constant:
                driven, weight = driven + torch.bmm(of_input, x), recurrent
            else:
                weight = torch.cat([of_input, recurrent], dim=2)
            key = name, layer, x.shape[-1]
            if key not in self._memory:
                sizes = len(bias), 0 if constant else x.shape[2], self.config.hidden, x.shape[-1]
                self._memory[key] = _Memory(steps, *sizes)
            last_layer = layer == layers - 1
            x = _Lstm.apply(None if constant else x, driven, weight, self._memory[key], last and last_layer)
        return x


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
    progress: Callable[[float], None] = lambda share: None,
) -> Twin:
    """A twin trained on motion of an arm that stayed cool for the whole horizon.

    Uses one thread and no global random state, so the result is the same in any process.

    Args:
        records: Profiles [time, 3, joint] at `config.record_hz`. The phases of a plan, given one by one, are cut and
            padded as they will be when scored.
        progress: Called with the share done, 0 to 1, after every epoch.

    Raises:
        ValueError: no records, or one that is misshapen or not finite.
        CollapsedPosterior: the latent of a network is unused although its joints moved in training.
        Diverged: no training of a network ended with finite weights.
    """
    done = count(1)

    def report() -> None:
        progress(min(next(done) / config.epochs, 1.0))  # a diverged restart costs more epochs

    with one_thread():
        windows = windows_of(records, config)
        draw = np.random.SeedSequence(_child(seed, windows.shape[2], 0))
        windows = draw_windows(windows, config.max_windows, draw)
        scaler = Scaler.fit(windows)
        names = net_names(config, scaler.joints)
        noise = (np.array(config.noise) / scaler.std).astype(np.float32).reshape(len(names), -1)  # [net, channel]
        z = torch.from_numpy(scaler.to_z(windows)).flatten(2)  # [batch, time, channel]
        x = [part.permute(1, 2, 0).contiguous() for part in z.chunk(len(names), dim=2)]
        seeds = [[_child(seed, n, restart) for restart in range(config.restarts)] for n in range(len(names))]
        results = _best_of(x, torch.from_numpy(noise), config, seeds, report)
    still = [bool(part.all()) for part in np.split(scaler.still, len(names))]
    amount = f"{len(windows)} windows from {sum(map(len, records)) / config.record_hz:.0f} s of motion"
    checked = [_checked(*each, arm, config, amount) for each in zip(names, results, still, strict=True)]
    fits, nets = zip(*checked, strict=True)
    data_hash = hash_records(records)
    return Twin(config, scaler, list(nets), arm=arm, data_hash=data_hash, seed=seed_text(seed), fits=fits)


def _checked(
    name: str, result: tuple[Fit, Weights] | None, is_still: bool, arm: str, config: TwinConfig, amount: str
) -> tuple[Fit, Weights]:
    """Fit and weights of a network of this name, trained on some amount of motion; raises as `train`."""
    label = "the whole arm" if name == "arm" else name.replace("_", " ")
    if result is None:
        raise Diverged(f"The training of {label} of '{arm}' ended without finite weights. Lower learning_rate or clip.")
    fit, _ = result
    kl_nats = fit.kl if config.kind == "vae" else None
    if collapsed(kl_nats, fit.active_units) and not (config.allow_collapse or is_still):
        raise CollapsedPosterior(
            f"Posterior collapse of {label} in the twin of '{arm}': KL {fit.kl:.2f} nat, {fit.active_units} active "
            f"latent unit(s), trained on {amount}. Some minutes of varied motion are needed; with enough of it, lower "
            "beta or train longer (epochs, max_windows). To keep it as a baseline, set allow_collapse."
        )
    return result


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
    restarts = config.restarts
    trial = max(1, round(config.trial * config.epochs)) if restarts > 1 else 0
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
