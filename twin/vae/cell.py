"""The gates of LSTM cells side by side, compiled: one step forward, and its gradient.

All arrays are float32 and contiguous, [net, ...]. Networks lie side by side; within one, hidden units and batch are one
axis of size m, batch last, so that every gate is one block. Gates are in the order of torch.nn.LSTM: input, forget,
cell, output. The matrix products are the caller's: `twin.vae.side_by_side` trains, `twin.vae.inference` scores.
"""

from typing import Any

import numpy as np

from fleet.jit import fused, jit_inline, kernel

Array = np.ndarray

_MOST = np.float32(7.9053111)
"""Beyond it, tanh rounds to one in the rational approximation."""
_A = tuple(
    map(
        np.float32,
        (
            4.89352455891786e-03,
            6.37261928875436e-04,
            1.48572235717979e-05,
            5.12229709037114e-08,
            -8.60467152213735e-11,
            2.00018790482477e-13,
            -2.76076847742355e-16,
        ),
    )
)
_B = tuple(map(np.float32, (4.89352518554385e-03, 2.26843463243900e-03, 1.18534705686654e-04, 1.19825839466702e-06)))
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
