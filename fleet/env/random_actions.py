"""Random legal actions for many arms at once."""

import numpy as np

from fleet.jit import kernel

Array = np.ndarray


def random_legal(mask: Array, rng: np.random.Generator) -> Array:
    """One action of each arm, uniform over its legal actions.

    Args:
        mask: Legal actions, int8 or bool [..., action]; the action is 0 (wait) if none is legal.

    Returns:
        int64 [...].
    """
    lead = mask.shape[:-1]
    rows = np.ascontiguousarray(mask, dtype=np.int8).reshape(-1, mask.shape[-1])
    actions = np.zeros(len(rows), dtype=np.int64)
    pick_legal.chosen()(rows, rng.random(len(rows)), actions)
    return actions.reshape(lead)


@kernel
def pick_legal(mask: Array, share: Array, out: Array) -> None:
    """Put the legal action at a share of a row's legal actions into `out`.

    Args:
        mask: int8 [row, action].
        share: In [0, 1), [row].
        out: int64 [row].
    """
    rows, actions = mask.shape
    for row in range(rows):
        legal = 0
        for k in range(actions):
            legal += mask[row, k] != 0
        left = int(share[row] * legal)
        for k in range(actions):
            if mask[row, k] != 0:
                if left == 0:
                    out[row] = k
                    break
                left -= 1
