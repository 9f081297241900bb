"""The folder of a training: whether one may begin or continue there, and whether it is complete."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from agents.learned.training_log import TrainingLength
from fleet.errors import FleetError
from fleet.files import atomic_path

TRAINING = "training.json"
"""Settings that a resume must repeat; written after the first state, so that a folder with it can be resumed."""
PAIRS_STATE, NETWORK_STATE = "training.npz", "training.pt"
POLICIES = ("pairs.json", "policy.json")
"""Cards of trained policies (`agents.learned.policy.CARD` needs PyTorch)."""


def holds_training(out: Path) -> bool:
    """Whether a folder has a training to resume."""
    return (out / TRAINING).is_file() and any((out / state).is_file() for state in (PAIRS_STATE, NETWORK_STATE))


def check_folder(out: Path, card: Mapping[str, Any], state: str, *, resume: bool) -> None:
    """Check that a training may begin in a folder, or continue from its state there.

    Raises:
        FleetError: a training or a policy in the folder without `resume`, `resume` without a training, or a training
            with another card.
    """
    if not resume:
        if holds_training(out):
            raise FleetError(f"'{out}' holds a training already. Continue it with --resume, or choose another --out.")
        if any((out / policy).is_file() for policy in POLICIES):
            raise FleetError(
                f"'{out}' holds a policy without a training to resume. Choose another --out, or move the policy."
            )
        return
    if not (holds_training(out) and (out / state).is_file()):
        raise FleetError(f"'{out}' holds no training to resume.")
    before = json.loads((out / TRAINING).read_text(encoding="utf-8"))
    was, now = (each | each.get("config", {}) | {"config": None} for each in (before, json.loads(json.dumps(card))))
    for name, value in now.items():
        if was.get(name) != value:
            raise FleetError(f"The training in '{out}' has {name} = {was.get(name)} (got {value}).")


def write_card(out: Path, card: Mapping[str, Any]) -> None:
    """Mark a folder as a training that can be resumed; call it after its first state is saved."""
    with atomic_path(out / TRAINING) as draft:
        draft.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def skip_complete(
    out: Path, plan: TrainingLength, iterations: int, before_s: float, tell: Callable[[str], None]
) -> bool:
    """Whether a training to resume is complete, which a sentence says.

    Raises:
        FleetError: it has its iterations, and the plan is not `in_total`.
    """
    if plan.share(iterations, before_s, before_s) < 1.0:
        return False
    if not plan.in_total:
        raise FleetError(f"The training in '{out}' has {iterations} iterations: --iterations must be more.")
    tell(f"Skipped the training in '{out}', because it is complete.")
    return True
