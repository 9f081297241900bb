"""Scoring with the trained networks of one arm, in NumPy, and the compiled LSTM cells that training shares with it.

All networks run together: a matrix product and `forward` for each layer and time step. Arrays are float32 and
contiguous, [net, ...]; within a network, hidden units and batch are one axis of size m, batch last, so that every gate
is one block of memory. Weights have the names and the order of gates (input, forget, cell, output) of torch.nn.LSTM and
torch.nn.Linear in `twin.vae.model.LstmVae`. Scoring needs no torch.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fleet.jit import fused, jit_inline, kernel
from fleet.motion import CHANNELS
from twin.vae.config import LOGVAR_RANGE, TwinConfig

Array = np.ndarray

_MOST = np.float32(7.9053111)
"""Beyond it, tanh rounds to one in the rational approximation."""
_ABOVE = (
    *(4.89352455891786e-03, 6.37261928875436e-04, 1.48572235717979e-05, 5.12229709037114e-08),
    *(-8.60467152213735e-11, 2.00018790482477e-13, -2.76076847742355e-16),
)
_BELOW = (4.89352518554385e-03, 2.26843463243900e-03, 1.18534705686654e-04, 1.19825839466702e-06)
_A, _B = (tuple(map(np.float32, each)) for each in (_ABOVE, _BELOW))
_HALF, _ONE = np.float32(0.5), np.float32(1.0)


@jit_inline
@fused
def tanh(x: Any) -> Any:  # float32
    """The hyperbolic tangent, to 3e-7, by a quotient of polynomials that compilers vectorise.

    Source: the rational approximation of Eigen, `generic_fast_tanh_float`.
    """
    x = _MOST if x > _MOST else x
    x = -_MOST if x < -_MOST else x
    q = x * x
    above = ((((((_A[6] * q + _A[5]) * q + _A[4]) * q + _A[3]) * q + _A[2]) * q + _A[1]) * q + _A[0]) * x
    return above / (((_B[3] * q + _B[2]) * q + _B[1]) * q + _B[0])


@jit_inline
@fused
def sigmoid(x: Any) -> Any:  # float32
    """The logistic function."""
    return _HALF + _HALF * tanh(_HALF * x)


@kernel
@fused
def forward(gates: Array, driven: Array, before: Array, after: Array, states: Array, skip: int, order: Array) -> None:
    """One step of all networks.

    Args:
        gates: Products of the recurrent weights; overwritten by the values of the gates, [net, 4 m].
        driven: Bias and input that do not change with time, added to them, [net, 4 m].
        before: Cells before the step, [net, m].
        after: Cells after it, [net, m]; another array, or the compiler does not vectorise.
        states: Hidden states after it, [net, skip + m]; the first `skip` numbers of each network are left alone.
        order: The networks, 0 … net − 1. Read from an array so that the compiler does not test all networks at once
            for overlap, which would fail and stop it from vectorising.
    """
    m = before.shape[1]
    for position in range(len(order)):
        n = order[position]
        for k in range(m):
            enter = sigmoid(gates[n, k] + driven[n, k])
            keep = sigmoid(gates[n, m + k] + driven[n, m + k])
            new = tanh(gates[n, 2 * m + k] + driven[n, 2 * m + k])
            leave = sigmoid(gates[n, 3 * m + k] + driven[n, 3 * m + k])
            cell = keep * before[n, k] + enter * new
            gates[n, k], gates[n, m + k], gates[n, 2 * m + k], gates[n, 3 * m + k] = enter, keep, new, leave
            after[n, k] = cell
            states[n, skip + k] = leave * tanh(cell)


def forward_uncompiled(
    gates: Array, driven: Array, before: Array, after: Array, states: Array, skip: int, _order: Array
) -> None:
    """As `forward`, in NumPy: for a process whose few scores are not worth the memory of numba, 80 MB."""
    gates += driven
    m = before.shape[1]
    enter, keep, new, leave = (gates[:, first : first + m] for first in range(0, 4 * m, m))
    for gate in (enter, keep, leave):
        gate[:] = _HALF + _HALF * np.tanh(_HALF * gate)
    np.tanh(new, out=new)
    after[:] = keep * before + enter * new
    np.multiply(leave, np.tanh(after), out=states[:, skip:])


@kernel
@fused
def backward(
    gates: Array,
    before: Array,
    after: Array,
    of_states: Array,
    of_cells: Array,
    of_gates: Array,
    total: Array,
    order: Array,
) -> None:
    """Gradients of one step of all networks.

    Args:
        gates: Values of the gates, [net, 4 m].
        before: Cells before the step, [net, m].
        after: Cells after it, [net, m].
        of_states: Gradient of the hidden states after it, [net, m].
        of_cells: Gradient of the cells after it by later steps; becomes that of the cells before it, [net, m].
        of_gates: Becomes the gradient of the products of the recurrent weights, [net, 4 m].
        total: The same is added to it, [net, 4 m].
        order: As in `forward`.
    """
    m = before.shape[1]
    for position in range(len(order)):
        n = order[position]
        for k in range(m):
            enter, keep, new, leave = gates[n, k], gates[n, m + k], gates[n, 2 * m + k], gates[n, 3 * m + k]
            bent, state = tanh(after[n, k]), of_states[n, k]
            cell = of_cells[n, k] + state * leave * (_ONE - bent * bent)
            of_enter = cell * new * enter * (_ONE - enter)
            of_keep = cell * before[n, k] * keep * (_ONE - keep)
            of_new = cell * enter * (_ONE - new * new)
            of_leave = state * bent * leave * (_ONE - leave)
            of_gates[n, k], of_gates[n, m + k], of_gates[n, 2 * m + k] = of_enter, of_keep, of_new
            of_gates[n, 3 * m + k] = of_leave
            total[n, k] += of_enter
            total[n, m + k] += of_keep
            total[n, 2 * m + k] += of_new
            total[n, 3 * m + k] += of_leave
            of_cells[n, k] = cell * keep


Linear = tuple[Array, Array]
"""Weights and biases of all networks."""
Weights = Mapping[str, Array]
"""Parameters of one network by name, such as `encoder.weight_ih_l0`, float32."""

_CHUNK = 128
"""Windows per pass: keeps the activations in cache."""


def shapes(config: TwinConfig, channels: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the parameters of one network."""
    hidden, latent = config.hidden, config.latent
    sizes: dict[str, tuple[int, ...]] = {}
    for lstm, size in (("encoder", channels), ("decoder", hidden)):
        for layer in range(config.layers):
            sizes[f"{lstm}.weight_ih_l{layer}"] = 4 * hidden, hidden if layer else size
            sizes[f"{lstm}.weight_hh_l{layer}"] = 4 * hidden, hidden
            sizes[f"{lstm}.bias_ih_l{layer}"] = sizes[f"{lstm}.bias_hh_l{layer}"] = (4 * hidden,)
    linear = {
        "summary": (hidden, hidden),
        "mu": (latent, hidden),
        "expand": (hidden, latent),
        "out": (channels, hidden),
    }
    if config.kind == "vae":
        linear["logvar"] = latent, hidden
    for name, (rows, columns) in linear.items():
        sizes[f"{name}.weight"], sizes[f"{name}.bias"] = (rows, columns), (rows,)
    return sizes


class Networks:
    """Networks that each read their share of an arm's channels, in z-scores; deterministic.

    Args:
        nets: Parameters of each network; all have the same shapes.
    """

    def __init__(self, nets: Sequence[Weights]) -> None:
        self._nets, self.count = nets, len(nets)
        chosen, self._order = forward.chosen(), np.arange(len(nets))
        self._advance = forward_uncompiled if chosen is forward.interpreted else chosen
        self.encoder, self.decoder = self._lstm("encoder"), self._lstm("decoder")
        self.summary, self.mu, self.expand, self.out = map(self._linear, ("summary", "mu", "expand", "out"))
        self.logvar = self._linear("logvar") if "logvar.weight" in nets[0] else None

    def posterior(self, z: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation, [batch, net, latent], of windows [batch, time, joint, channel]."""
        mu, sigma = _in_chunks(self._encode, z)
        return mu, sigma

    def decode(self, latent: Array, steps: int) -> Array:
        """Windows decoded from latents [batch, net, latent], float32 [batch, time, joint, channel]."""
        return _in_chunks(lambda part: (self._decode(part, steps),), np.asarray(latent, dtype=np.float32))[0]

    def reconstruct(self, z: Array) -> tuple[Array, Array]:
        """Windows [batch, time, joint, channel] decoded from their posterior means, float32, and these means."""

        def both(part: Array) -> tuple[Array, Array]:
            mu = self._encode(part)[0]
            return self._decode(mu, z.shape[1]), mu

        z_hat, mu = _in_chunks(both, z)
        return z_hat, mu

    def _encode(self, z: Array) -> tuple[Array, Array]:
        batch, steps, joints, channels = z.shape
        parts = z.reshape(batch, steps, self.count, joints * channels // self.count).transpose(1, 2, 3, 0)
        summary = np.tanh(_affine(self._unroll(self.encoder, parts, steps)[-1], self.summary))
        mu = _affine(summary, self.mu)
        if self.logvar is None:
            sigma = np.zeros_like(mu)
        else:
            sigma = np.exp(0.5 * np.clip(_affine(summary, self.logvar), *LOGVAR_RANGE))
        return mu.transpose(2, 0, 1), sigma.transpose(2, 0, 1)

    def _decode(self, latent: Array, steps: int) -> Array:
        first = np.tanh(_affine(latent.transpose(1, 2, 0), self.expand))
        z = _affine(self._unroll(self.decoder, first, steps), self.out)  # [time, net, channel, batch]
        joints = z.shape[1] * z.shape[2] // len(CHANNELS)
        return z.transpose(3, 0, 1, 2).reshape(z.shape[3], steps, joints, len(CHANNELS))

    def _unroll(self, layers: Sequence[Linear], x: Array, steps: int) -> Array:
        """Hidden states of the highest layer, [time, net, hidden, batch].

        Args:
            layers: Weight [net, 4 hidden, input + hidden] and bias [net, 4 hidden, 1] of each layer.
            x: Inputs [time, net, size, batch], or [net, size, batch] at every step.
        """
        for weight, bias in layers:
            hidden, batch = bias.shape[1] // 4, x.shape[-1]
            size = weight.shape[2] - hidden
            driven = np.broadcast_to(bias, (self.count, 4 * hidden, batch))
            if x.ndim == 3:
                driven, weight, size = driven + np.matmul(weight[:, :, :size], x), weight[:, :, size:], 0
            states = np.zeros((steps + 1, self.count, size + hidden, batch), np.float32)
            if size:
                states[:-1, :, :size] = x
            gates, cells = np.empty_like(driven, order="C"), np.zeros((2, self.count, hidden * batch), np.float32)
            flat, flat_driven = (np.ascontiguousarray(each).reshape(self.count, -1) for each in (gates, driven))
            for step in range(steps):
                np.matmul(weight, states[step], out=gates)
                after = states[step + 1].reshape(self.count, -1)
                before, now = cells[step % 2], cells[(step + 1) % 2]
                self._advance(flat, flat_driven, before, now, after, size * batch, self._order)
            x = states[1:, :, size:]
        return x

    def _linear(self, name: str) -> Linear:
        """Weight [net, out, in] and bias [net, out, 1]."""
        weight = np.stack([net[f"{name}.weight"] for net in self._nets])
        return weight, np.stack([net[f"{name}.bias"][:, None] for net in self._nets])

    def _lstm(self, name: str) -> list[Linear]:
        layers = sum(key.startswith(f"{name}.weight_hh_l") for key in self._nets[0])

        def stacked(kind: str, layer: int) -> Array:
            return np.stack([net[f"{name}.{kind}_l{layer}"] for net in self._nets])

        return [
            (
                np.concatenate([stacked("weight_ih", n), stacked("weight_hh", n)], axis=2),
                (stacked("bias_ih", n) + stacked("bias_hh", n))[:, :, None],
            )
            for n in range(layers)
        ]


def _affine(x: Array, linear: Linear) -> Array:
    return np.matmul(linear[0], x) + linear[1]


def _in_chunks(function: Callable[[Array], tuple[Array, ...]], values: Array) -> list[Array]:
    """The results of a function of a batch, computed chunk by chunk."""
    parts = [function(values[first : first + _CHUNK]) for first in range(0, max(len(values), 1), _CHUNK)]
    return [np.concatenate(result) for result in zip(*parts, strict=True)]
