"""Networks of one shape trained side by side, with a network axis in front: `twin.vae.model.LstmVae`, many at once.

Windows are [time, net, channel, batch]: with the batch last, each gate of a cell is one block of memory. Between the
matrix products, `twin.vae.cell` computes a whole time step at once. torch.nn.LSTM takes three times as long for windows
this small (`benchmarks/bench_twin.py`), and `torch.vmap` does not run it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from twin.vae import cell
from twin.vae.config import LOGVAR_RANGE, TwinConfig
from twin.vae.model import LstmVae


@dataclass(eq=False)
class _Memory:
    """Arrays of one layer that the gradient needs, kept from step to step."""

    steps: int
    nets: int
    inputs: int
    hidden: int
    batch: int

    def __post_init__(self) -> None:
        steps, nets, hidden, batch = self.steps, self.nets, self.hidden, self.batch
        self.states = torch.zeros(steps + 1, nets, self.inputs + hidden, batch)
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
        advance, skip, flat = cell.forward.compiled, memory.inputs * memory.batch, rows(driven)
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
        retreat, of_weight = cell.backward.compiled, torch.zeros_like(weight)
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
        hidden, layers = self.config.hidden, self.config.layers
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
            memory = self._memory_of(name, layer, steps, len(bias), 0 if constant else x.shape[2], hidden, x.shape[-1])
            x = _Lstm.apply(None if constant else x, driven, weight, memory, last and layer == layers - 1)
        return x

    def _memory_of(self, name: str, layer: int, steps: int, *sizes: int) -> _Memory:
        nets, inputs, hidden, batch = sizes
        key = name, layer, batch
        if key not in self._memory:
            self._memory[key] = _Memory(steps, nets, inputs, hidden, batch)
        return self._memory[key]
