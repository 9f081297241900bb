"""A learned score of pairs of arm and option: `wsept` with learned weights, matched as `wsept` matches.

score = rate · exp(f) + g · mean rate, where `rate` is the expected worth per time with learned prices
(`agents.pairs.Worth`), and f and g are weighted sums of the pair's numbers. All parameters are one vector; zeros give
`wsept` exactly.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from agents.assignment import Matching
from agents.pairs import FILLS, PAIR_FEATURES, Worth, pairs_of
from agents.policy import Local, plans_of
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.observation import FIELDS, Observation

Array = np.ndarray

PAIRS, PAIRS_CARD = "pairs.npy", "pairs.json"
OUTPUTS = 2
PARAMETERS = len(Worth._fields) + PAIR_FEATURES * OUTPUTS
"""Length of the vector of parameters."""


def first_parameters() -> Array:
    """Initial parameters of a training, float [PARAMETERS]: `wsept`, except for the end of the shift and faults.

    A job that cannot end before the shift does has no value, and one that just can has twice the score. A predicted
    peak may be 4 K above the error limit, and deviates twice as much.
    """
    parameters = np.zeros(PARAMETERS)
    first = Worth(0.4, np.log(2.0), 0.0, 0.0, 0.0, end=1.0, overhead=0.0)  # pyright: ignore[reportArgumentType]
    parameters[: len(first)] = first
    parameters[len(Worth._fields) + FILLS * OUTPUTS] = 0.7
    return parameters


def scores(seen: Observation, parameters: Array) -> Array:
    """Scores of all options, [env, arm, option]; −inf where a claim is not legal or not wanted.

    Args:
        seen: Observations [env, arm].
        parameters: [env, PARAMETERS].
    """
    worth, weights = np.split(parameters, [len(Worth._fields)], axis=-1)
    pairs = pairs_of(_without_empty(seen), Worth(*worth.T))
    each = weights.reshape(-1, PAIR_FEATURES, OUTPUTS)[pairs.at[0]]
    f, g = np.clip(np.einsum("pk,pko->op", pairs.features, each), -3.0, 3.0)
    score = pairs.rate * np.exp(f) + g * pairs.scale
    result = np.full(seen.duration_s.shape, -np.inf)
    result[pairs.at] = np.where(score > 0, score, -np.inf)
    return result


class PairPolicy(Matching):
    """Matching by learned scores of arms and jobs. Scope central: it compares all pairs.

    Args:
        parameters: float [PARAMETERS], as a training found them.
    """

    only_choices = True

    def __init__(self, parameters: Array) -> None:
        self._parameters = np.asarray(parameters, dtype=float)[None]

    def cost(self, observations: Sequence[Observation]) -> Array:
        """Minus the scores, [arm, option]; inf for claims that are not wanted."""
        return -scores(_stacked(observations), self._parameters)[0]


PAIRS_FORMAT = 4
"""Increase it when the numbers of a pair or the network change."""


def save_pairs(parameters: Array, folder: Path, **details: object) -> None:
    """Write parameters as a policy into a folder, made if need be; each file is written atomically.

    Args:
        details: Additional JSON values of the card.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / PAIRS) as draft, draft.open("wb") as file:
        np.save(file, parameters.astype(np.float32))
    with atomic_path(folder / PAIRS_CARD) as draft:
        card = {"format": PAIRS_FORMAT, **details}
        draft.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def load_pairs(folder: Path) -> PairPolicy:
    """The policy that `save_pairs` wrote.

    Raises:
        CheckpointError: a file is missing, damaged or of another format.
    """
    return PairPolicy(_parameters(folder))


def _parameters(folder: Traversable) -> Array:
    """Parameters in a folder; errors as of `load_pairs`."""
    try:
        found = json.loads((folder / PAIRS_CARD).read_text(encoding="utf-8"))["format"]
        with (folder / PAIRS).open("rb") as opened:
            parameters = np.load(opened, allow_pickle=False)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"There is no policy over pairs in '{folder}' ({error}).") from error
    if found != PAIRS_FORMAT:
        raise CheckpointError(f"{folder / PAIRS_CARD}: format {found} is not {PAIRS_FORMAT}. Train the policy again.")
    if parameters.shape != (PARAMETERS,) or not np.isfinite(parameters).all():
        raise CheckpointError(f"{folder / PAIRS}: must be {PARAMETERS} finite numbers (shape {parameters.shape}).")
    return parameters


@cache
def shipped_parameters() -> Array:
    """The parameters that come with the project: the best on the validation split of several trainings."""
    return _parameters(resources.files("agents") / "weights")


class WseptLearned(PairPolicy):
    """As `wsept`, by scores that were learned on the training split of the suite with the true state. Scope central."""

    only_choices = True

    def __init__(self) -> None:
        super().__init__(shipped_parameters())


class WseptUntrained(PairPolicy):
    """As `wsept_learned`, with the parameters that a training begins with: its ablation. Scope central."""

    only_choices = True

    def __init__(self) -> None:
        super().__init__(first_parameters())


class WseptLearnedLocal(Local):
    """As `wsept_learned` for a fleet of one: every arm claims the job with the highest score for it. Scope arm."""

    central = WseptLearned
    only_choices = True


def _without_empty(seen: Observation) -> Observation:
    """The observation without trailing slots that are empty in all envs."""
    plans = plans_of(seen)
    legal = seen.action_mask[..., 1:-1].any(axis=(0, 1)).reshape(-1, plans).any(axis=-1)
    used = np.flatnonzero(legal | seen.offered.any(axis=(0, 1)))
    slots = int(used[-1]) + 1 if len(used) else 1
    if slots == seen.offered.shape[-1]:
        return seen
    ends: dict[tuple[str, ...], int] = {("slot",): slots, ("option",): slots * plans}
    short = {f.name: getattr(seen, f.name)[..., : ends[f.axes]] for f in FIELDS if f.axes in ends}
    return replace(seen, **short, action_mask=seen.action_mask[..., [*range(1 + slots * plans), -1]])


def _stacked(seen: Sequence[Observation]) -> Observation:
    """Observations of arms as one with the axes [1, arm]."""
    names = [*(field.name for field in FIELDS if not field.name.startswith("peer_")), "action_mask"]
    stacked = {name: np.stack([getattr(each, name) for each in seen])[None] for name in names}
    peers = {field.name: np.zeros(0) for field in FIELDS if field.name.startswith("peer_")}
    return Observation(**stacked, **peers)
