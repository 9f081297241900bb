"""Random legal actions for many arms at once: what a batch is warmed up and measured with."""

import numpy as np

from fleet.sim.jit import entry

Array = np.ndarray


def random_legal(mask: Array, rng: np.random.Generator) -> Array:
    """One action of each arm, every legal one as likely as the others.

    Args:
        mask: Legal actions, int8 or bool [..., action]; where none is legal, the answer is 0, which waits.

    Returns:
        int64 [...].
    """
    lead = mask.shape[:-1]
    rows = np.ascontiguousarray(mask, dtype=np.int8).reshape(-1, mask.shape[-1])
    actions = np.zeros(len(rows), dtype=np.int64)
    pick(rows, rng.random(len(rows)), actions)
    return actions.reshape(lead)


@entry
def pick(mask: Array, share: Array, out: Array) -> None:
    """The legal action at that share, in [0, 1), of a row's legal actions.

    Args:
        mask: int8 [row, action].
        share: [row].
        out: Takes the actions, int64 [row].
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
