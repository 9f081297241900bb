"""All networks of an arm at once, in numpy: for few windows, where torch spends its time on calls, not on sums.

The seven joints' networks are alike, so each time step is one stacked multiplication for all. Gates stand in the order
output, input, forget, cell. Since sigmoid x = ½ + ½ tanh ½x, the weights of the first three are halved once and one
tanh serves all four.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor, nn

from twin.model import LstmVae

Array = np.ndarray

_HALF = np.float32(0.5)


@dataclass(frozen=True, eq=False)
class _Linear:
    """The same linear layer of every network."""

    weight: Array
    """[net, in, out]."""
    bias: Array
    """[net, 1, out]."""

    @classmethod
    def of(cls, layers: Sequence[nn.Linear]) -> "_Linear":
        weight = np.stack([layer.weight.numpy().T for layer in layers])
        return cls(weight, np.stack([layer.bias.numpy() for layer in layers])[:, None])

    def __call__(self, x: Array) -> Array:
        """[net, row, in] to [net, row, out]."""
        y = np.matmul(x, self.weight)
        y += self.bias
        return y


@dataclass(frozen=True, eq=False)
class _Layer:
    """The same LSTM layer of every network."""

    read: Array
    """[gate, net, in, hidden]."""
    recur: Array
    """[gate, net, hidden, hidden]."""
    bias: Array
    """[gate, net, 1, hidden]."""

    @classmethod
    def of(cls, lstms: Sequence[nn.LSTM], layer: int) -> "_Layer":
        def stacked(name: str) -> Array:
            """This parameter of all, [gate, net, in or 1, hidden]."""
            apart = [_gates(getattr(lstm, f"{name}_l{layer}")) for lstm in lstms]
            return np.ascontiguousarray(np.stack(apart, axis=1).swapaxes(-1, -2))

        return cls(stacked("weight_ih"), stacked("weight_hh"), stacked("bias_ih") + stacked("bias_hh"))

    def drive(self, x: Array) -> Array:
        """What inputs [net, time, batch, in] add to the gates, [gate, net, time, batch, hidden]."""
        rows = np.matmul(x.reshape(len(x), -1, x.shape[-1]), self.read)
        rows += self.bias
        return rows.reshape(len(rows), *x.shape[:-1], -1)

    def run(self, drive: Array) -> Array:
        """Outputs from a state of zeros, [net, time, batch, hidden]."""
        _, nets, steps, batch, hidden = drive.shape
        gates = np.empty((4, nets, batch, hidden), np.float32)
        share, (output, enter, forget, new) = gates[:3], gates
        cell = np.zeros((nets, batch, hidden), np.float32)
        made = np.empty((nets, steps, batch, hidden), np.float32)
        h = np.zeros_like(cell)
        for t in range(steps):
            np.matmul(h, self.recur, out=gates)
            np.add(gates, drive[:, :, t], out=gates)
            np.tanh(gates, out=gates)
            np.multiply(share, _HALF, out=share)
            np.add(share, _HALF, out=share)
            np.multiply(cell, forget, out=cell)
            np.multiply(enter, new, out=enter)
            np.add(cell, enter, out=cell)
            np.tanh(cell, out=new)
            h = made[:, t]
            np.multiply(output, new, out=h)
        return made


class Grouped:
    """Networks of one configuration, on arrays: the same numbers as `LstmVae` but for rounding."""

    def __init__(self, nets: Sequence[LstmVae]) -> None:
        layers = range(nets[0].encoder.num_layers)
        self._encoder = [_Layer.of([net.encoder for net in nets], layer) for layer in layers]
        self._decoder = [_Layer.of([net.decoder for net in nets], layer) for layer in layers]
        self._summary, self._mu, self._expand, self._out = (
            _Linear.of([getattr(net, name) for net in nets]) for name in ("summary", "mu", "expand", "out")
        )

    def reconstruct(self, x: Array) -> Array:
        """Windows in z-scores decoded from the mean of their posterior, both float32 [net, time, batch, channel]."""
        nets, steps, batch, _ = x.shape
        for layer in self._encoder:
            x = layer.run(layer.drive(x))
        mu = self._mu(np.tanh(self._summary(x[:, -1])))
        told = np.tanh(self._expand(mu))[:, None]
        for layer in self._decoder:
            drive = layer.drive(told)
            told = layer.run(np.broadcast_to(drive, (*drive.shape[:2], steps, *drive.shape[3:])))
        return self._out(told.reshape(nets, steps * batch, -1)).reshape(nets, steps, batch, -1)


def _gates(parameter: Tensor) -> Array:
    """torch's input, forget, cell, output, [4·hidden, in] or [4·hidden], as ours, [gate, hidden, in or 1]."""
    enter, forget, new, output = parameter.numpy().reshape(4, len(parameter) // 4, -1)
    return np.stack([_HALF * output, _HALF * enter, _HALF * forget, new])
