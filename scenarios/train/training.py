"""The loop of a training and its folder: begin or resume, validate, keep the best policy, and log."""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from agents.learned.cards import OPTION_OF, POLICIES, settings_of
from agents.learned.config import TrainingLength
from agents.learned.evolution import CURVE, TrainingLog, read_log
from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.progress import Progress, quiet

TRAINING = "training.json"
"""Settings that a resume must repeat; written after the first state, so that a folder with it can be resumed."""
PAIRS_STATE, NETWORK_STATE = "training.npz", "training.pt"


class Learner(Protocol):
    """What is trained."""

    state_file: str
    unit: str
    """Of a validation."""
    curves: tuple[str, ...]
    """Numbers of an iteration that are plotted."""
    teacher_name: str
    """Policy that the training begins with; "" without one."""
    search: Any
    """`agents.learned.evolution.Evolution` or `agents.learned.ppo.Trainer`."""

    def validate(self) -> float:
        """Return the validation of the present policy."""
        ...

    def validate_teacher(self) -> float | None:
        """Return the validation of the policy that the training begins with; None without one."""
        ...

    def iterate(self) -> Iterator[dict[str, Any]]:
        """Endless iterations, each as a row of the log."""
        ...

    def save_policy(self, out: Path, validation: float, **details: Any) -> None: ...


@dataclass(frozen=True)
class Trained:
    """Result of a training in all its sessions."""

    iterations: int
    kept: int
    """Iteration of the saved policy."""
    best: float
    """Its validation."""
    seconds: float
    interrupted: bool


def run_training(
    learner: Learner,
    out: Path,
    plan: TrainingLength,
    card: Mapping[str, Any],
    *,
    resume: bool,
    progress: Progress = quiet,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Trained:
    """Write into a folder the policy with the best validation, the last state for a resume, and the curves.

    Ctrl-C ends the training early and keeps its result; before the end of the validation of iteration 0 there is none.
    Call `check_folder` before.

    Args:
        card: Content of training.json and of the policy's card.
        tell: Called with a sentence after every validation.

    Raises:
        FleetError: the training has the iterations of the plan, which is not `in_total`.
    """
    search, state = learner.search, out / learner.state_file
    numbers = search.load(state) if resume else {}
    best, before_s = numbers.get("best", -np.inf), numbers.get("seconds", 0.0)
    if resume and plan.share(search.done, before_s, before_s) >= 1.0:
        if not plan.in_total:
            raise FleetError(f"The training in '{out}' has {search.done} iterations: --iterations must be more.")
        tell(f"Skipped the training in '{out}', because it is complete.")
        return Trained(search.done, _kept(out), best, before_s, interrupted=False)
    out.mkdir(parents=True, exist_ok=True)
    log, interrupted, validated = TrainingLog(out, search.done), False, search.done
    began_s = time.monotonic() - before_s  # as if the sessions had followed each other
    teacher = numbers.get("teacher", np.nan)
    if not resume:
        validation = learner.validate_teacher()
        teacher = np.nan if validation is None else validation
    compared = {} if np.isnan(teacher) else {"teacher": teacher}

    def validate() -> None:
        nonlocal best, validated
        validation = learner.validate()
        if not holds_training(out):
            search.save(state, teacher=teacher, best=best)  # without a policy yet
            _write_card(out, card)
        if validation > best:
            best = validation
            learner.save_policy(out, validation, **card, **compared)
        seconds, validated = time.monotonic() - began_s, search.done
        search.save(state, teacher=teacher, best=best, seconds=seconds)
        log.add(search.done, {"iteration": search.done, "validation": validation, **compared})
        text = "".join(f", {name} {value:.4g}" for name, value in compared.items())
        tell(f"Iteration {search.done}: validation {validation:.4g}, best {best:.4g}{text}.")

    if best == -np.inf:
        validate()
    share = plan.share(search.done, time.monotonic() - began_s, before_s)
    try:
        for row in learner.iterate() if share < 1.0 else ():
            log.add(search.done, row)
            share = plan.share(search.done, time.monotonic() - began_s, before_s)
            progress(f"iteration {search.done}, best {best:.4g}", min(share, 1.0))
            if search.done % plan.validate_every == 0:
                validate()
            if share >= 1.0:
                break
    except KeyboardInterrupt:
        interrupted = True
    if validated < search.done:
        validate()
    draw_curves([out], out / CURVE, learner.unit, learner.curves, teacher_name=learner.teacher_name)
    return Trained(search.done, _kept(out), best, time.monotonic() - began_s, interrupted)


def _kept(out: Path) -> int:
    """The iteration of the saved policy: the first with the best validation."""
    rows = [row for row in read_log(out) if "validation" in row]
    return max(rows, key=lambda row: row["validation"], default={"iteration": 0})["iteration"]


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
    try:
        before = json.loads((out / TRAINING).read_text(encoding="utf-8"))
    except ValueError as error:
        raise FleetError(f"'{out / TRAINING}' is damaged ({error}); the training cannot be resumed.") from error
    if not isinstance(before, dict):
        raise FleetError(f"'{out / TRAINING}' is damaged (no JSON object); the training cannot be resumed.")
    was, now = settings_of(before), settings_of(json.loads(json.dumps(card)))
    for name, value in now.items():
        if was.get(name) != value:
            shown = OPTION_OF.get(name, name)
            raise FleetError(f"The training in '{out}' has {shown} = {was.get(name)!r} (got {value!r}).")


def _write_card(out: Path, card: Mapping[str, Any]) -> None:
    with atomic_path(out / TRAINING) as draft:
        draft.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def draw_curves(
    folders: Sequence[Path], picture: Path, unit: str, curves: Sequence[str] = (), *, teacher_name: str
) -> None:
    """Plot the validation of trainings against the iteration with that of their teacher; below it some numbers.

    Args:
        unit: Of a validation.
        curves: Names of the numbers of an iteration.
        teacher_name: Policy that the trainings begin with; "" without one.
    """
    from matplotlib.figure import Figure  # without a display

    figure = Figure(figsize=(8, 6 if curves else 4), layout="constrained")
    top, *below = figure.subplots(2 if curves else 1, 1, sharex=True, squeeze=False)[:, 0]
    teacher: float | None = None
    for folder in folders:
        rows = read_log(folder)
        judged = [row for row in rows if "validation" in row]
        teacher = judged[0].get("teacher") if judged else teacher
        top.plot([row["iteration"] for row in judged], [row["validation"] for row in judged], "o-", ms=3,
                 label=folder.name)  # fmt: skip
        iterations = [row for row in rows if "number" in row]
        for axes in below:
            for name in curves:
                label = name.replace("_", " ")
                axes.plot([row["number"] for row in iterations], [row[name] for row in iterations], label=label)
    if teacher is not None:
        top.axhline(teacher, color="k", lw=1, ls="--", label=teacher_name)
    top.set_ylabel(f"validation, {unit}")
    for axes in (top, *below):
        axes.legend(frameon=False)
        axes.grid(alpha=0.3)
    (below[0] if below else top).set_xlabel("iteration")
    with atomic_path(picture) as draft:
        figure.savefig(draft, dpi=120, format="png")
