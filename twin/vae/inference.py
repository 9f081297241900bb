"""The trained networks of one arm on windows of all joints, in NumPy: scoring needs no torch.

All networks run together, one matrix product per layer and time step. Weights have the names and the order of gates
(input, forget, cell, output) of torch.nn.LSTM and torch.nn.Linear in `twin.vae.model.LstmVae`.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fleet.motion import CHANNELS
from twin.vae.config import LOGVAR_RANGE, TwinConfig

Array = np.ndarray
Weights = Mapping[str, Array]
"""Parameters of one network by name, such as `encoder.weight_ih_l0`, float32."""

_CHUNK = 64
"""Windows per pass: keeps the activations in cache."""


def shapes(config: TwinConfig, channels: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the parameters of one network."""
    hidden, latent = config.hidden, config.latent
    found: dict[str, tuple[int, ...]] = {}
    for lstm, size in (("encoder", channels), ("decoder", hidden)):
        for layer in range(config.layers):
            found[f"{lstm}.weight_ih_l{layer}"] = 4 * hidden, hidden if layer else size
            found[f"{lstm}.weight_hh_l{layer}"] = 4 * hidden, hidden
            found[f"{lstm}.bias_ih_l{layer}"] = found[f"{lstm}.bias_hh_l{layer}"] = (4 * hidden,)
    linear = {
        "summary": (hidden, hidden),
        "mu": (latent, hidden),
        "expand": (hidden, latent),
        "out": (channels, hidden),
    }
    if config.kind == "vae":
        linear["logvar"] = latent, hidden
    for name, (rows, columns) in linear.items():
        found[f"{name}.weight"], found[f"{name}.bias"] = (rows, columns), (rows,)
    return found


class Networks:
    """Networks that each read their share of an arm's channels, in z-scores; deterministic.

    Args:
        nets: Parameters of each network; all have the same shapes.
    """

    def __init__(self, nets: Sequence[Weights]) -> None:
        self._nets, self.count = nets, len(nets)
        self.encoder, self.decoder = self._lstm("encoder"), self._lstm("decoder")
        self.summary, self.mu, self.expand, self.out = map(self._linear, ("summary", "mu", "expand", "out"))
        self.logvar = self._linear("logvar") if "logvar.weight" in nets[0] else None

    def encode(self, z: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation, [batch, net, latent], of windows [batch, time, joint, channel]."""
        parts = z.reshape(*z.shape[:2], self.count, -1).transpose(1, 2, 0, 3)
        hidden = np.ascontiguousarray(parts)  # [time, net, batch, channel]
        for layer in self.encoder:
            hidden = layer(hidden)
        summary = np.tanh(_affine(hidden[-1], self.summary))
        mu = _affine(summary, self.mu)
        if self.logvar is None:
            sigma = np.zeros_like(mu)
        else:
            sigma = np.exp(0.5 * np.clip(_affine(summary, self.logvar), *LOGVAR_RANGE))
        return mu.swapaxes(0, 1), sigma.swapaxes(0, 1)

    def decode(self, latent: Array, steps: int) -> Array:
        """Windows decoded from latents [batch, net, latent], [batch, time, joint, channel]."""
        first = np.tanh(_affine(latent.swapaxes(0, 1), self.expand))
        hidden = np.broadcast_to(first, (steps, *first.shape))
        for layer in self.decoder:
            hidden = layer(hidden)
        z = np.matmul(hidden, self.out[0]) + self.out[1]  # [time, net, batch, channel]
        return z.transpose(2, 0, 1, 3).reshape(z.shape[2], steps, -1, len(CHANNELS))

    def _linear(self, name: str) -> tuple[Array, Array]:
        """Weight [net, in, out] and bias [net, 1, out]."""
        weight = np.stack([net[f"{name}.weight"].T for net in self._nets])
        return weight, np.stack([net[f"{name}.bias"][None] for net in self._nets])

    def _lstm(self, name: str) -> "list[_Layer]":
        layers = sum(key.startswith(f"{name}.weight_hh_l") for key in self._nets[0])
        return [_Layer(self._nets, name, layer) for layer in range(layers)]


class _Layer:
    """One layer of an LSTM, for all networks.

    The weights of the three gates that are logistic functions are halved, σ(x) = (1 + tanh(x / 2)) / 2, so that one
    tanh serves all four.
    """

    def __init__(self, nets: Sequence[Weights], name: str, layer: int) -> None:
        hidden = nets[0][f"{name}.weight_hh_l{layer}"].shape[1]
        half = np.repeat(np.array([0.5, 0.5, 1.0, 0.5], np.float32), hidden)

        def stacked(kind: str) -> Array:
            return np.stack([(net[f"{name}.{kind}_l{layer}"].T * half) for net in nets])

        self._input, self._recurrent = stacked("weight_ih"), stacked("weight_hh")  # [net, in, 4 hidden]
        self._bias = (stacked("bias_ih") + stacked("bias_hh"))[:, None]
        self._hidden = hidden

    def __call__(self, inputs: Array) -> Array:
        """Hidden states [time, net, batch, hidden] after each step of the inputs [time, net, batch, in]."""
        constant = inputs.strides[0] == 0
        driven = np.matmul(inputs[:1] if constant else inputs, self._input) + self._bias
        size = self._hidden
        states = np.empty((*inputs.shape[:3], size), np.float32)
        state, cell = np.zeros_like(states[0]), np.zeros_like(states[0])
        for step in range(len(inputs)):
            gates = np.matmul(state, self._recurrent)
            gates += driven[0 if constant else step]
            np.tanh(gates, out=gates)
            enter, keep, new, leave = (gates[..., n * size : (n + 1) * size] for n in range(4))
            cell = 0.5 * ((1.0 + keep) * cell + (1.0 + enter) * new)
            states[step] = state = 0.5 * (1.0 + leave) * np.tanh(cell)
        return states


def _affine(x: Array, linear: tuple[Array, Array]) -> Array:
    return np.matmul(x, linear[0]) + linear[1]


def posterior(networks: Networks, z: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the latent of windows [batch, time, joint, channel], [batch, net, latent]."""
    mu, sigma = _in_chunks(networks.encode, z)
    return mu, sigma


def decode(networks: Networks, latent: Array, steps: int) -> Array:
    """Windows decoded from latents [batch, net, latent], float32 [batch, time, joint, channel]."""
    return _in_chunks(lambda part: (networks.decode(part, steps),), np.asarray(latent, dtype=np.float32))[0]


def reconstruct(networks: Networks, z: Array) -> tuple[Array, Array]:
    """Windows [batch, time, joint, channel] decoded from the means of their posteriors, float32, and these means.

    The means are [batch, net, latent].
    """

    def both(part: Array) -> tuple[Array, Array]:
        mu = networks.encode(part)[0]
        return networks.decode(mu, z.shape[1]), mu

    z_hat, mu = _in_chunks(both, z)
    return z_hat, mu


def _in_chunks(function: Callable[[Array], tuple[Array, ...]], values: Array) -> list[Array]:
    """The results of a function of a batch, computed chunk by chunk."""
    parts = [function(values[first : first + _CHUNK]) for first in range(0, max(len(values), 1), _CHUNK)]
    return [np.concatenate(result) for result in zip(*parts, strict=True)]
