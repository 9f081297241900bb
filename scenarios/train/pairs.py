"""Train scores of arm–job pairs over a split of the suite by evolution, with validation on another split."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from agents.learned.config import TrainingLength
from agents.learned.evolution import CURVE, Evolution, EvolutionConfig, TrainingLog, read_log
from agents.pairs import PARAMETERS, first_parameters, save_pairs
from fleet.files import atomic_path
from scenarios.train.instances import (
    PAIRS_STATE,
    Trained,
    TrainingInstance,
    check_folder,
    holds_training,
    rewards,
    skip_complete,
    write_card,
)

Array = np.ndarray

LEAST_SPAN = 0.04
"""Shortest span of an instance in training, as a share of the value of its jobs."""
MOST_LOSS = 1.0
"""A sample loses at most this much to the best one in a shift, so that one shift does not decide an iteration."""


@dataclass(frozen=True, kw_only=True)
class PairPlan(TrainingLength):
    """Length of a training, and its validation."""

    instances: int = 12
    """Instances of an iteration, of different cells; all samples have the same shifts."""
    validate_every: int = 8


def train_pairs(
    grounds: Sequence[TrainingInstance],
    judges: Sequence[TrainingInstance],
    config: EvolutionConfig,
    out: Path,
    plan: PairPlan,
    *,
    card: dict[str, object],
    resume: bool = False,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Trained:
    """Write into a folder the parameters with the best validation as a policy, the last state, and the curves.

    Iteration 0 is `agents.pairs.first_parameters`, the teacher is `wsept`. Ctrl-C ends the training early and
    keeps its result; before the end of the validation of iteration 0 there is none.

    Args:
        grounds, judges: Instances of training and of validation.
        card: What else `pairs.json` and `training.json` say; a resume must have the same.

    Raises:
        FleetError: a training in the folder without `resume`, `resume` without a training, or another training, or one
            that has the iterations of the plan.
    """
    card = {**card, "config": asdict(config), "instances": plan.instances}
    check_folder(out, card, PAIRS_STATE, resume=resume)
    search = Evolution(first_parameters(), config)
    teacher, best, before_s, interrupted = np.nan, -np.inf, 0.0, False
    if resume:
        numbers = search.load(out / PAIRS_STATE)
        teacher, best, before_s = numbers["teacher"], numbers["best"], numbers.get("seconds", 0.0)
    began_s = time.monotonic() - before_s  # as if the sessions had followed each other

    def result() -> Trained:
        return Trained(search.done, best, time.monotonic() - began_s, interrupted)

    if resume and skip_complete(out, plan, search.done, before_s, tell):
        return result()
    out.mkdir(parents=True, exist_ok=True)
    log = TrainingLog(out)

    def validate() -> None:
        nonlocal best
        found = validation(judges, search.average)
        if not holds_training(out):
            search.save(out / PAIRS_STATE, teacher=teacher, best=best)  # without a policy yet
            write_card(out, card)
        if found > best:
            best = found
            save_pairs(search.average, out, **card, iterations=search.done, validation=best, teacher=teacher)
        search.save(out / PAIRS_STATE, teacher=teacher, best=best, seconds=time.monotonic() - began_s)
        log.add(search.done, {"iteration": search.done, "validation": found, "teacher": teacher})
        tell(f"Iteration {search.done}: {found:.4f}, best {best:.4f}, wsept {teacher:.4f}.")

    if not resume:
        teacher = validation(judges, np.zeros(PARAMETERS))
    if best == -np.inf:
        validate()
    validated = search.done
    try:
        while plan.share(search.done, time.monotonic() - began_s, before_s) < 1.0:
            began_iteration_s = time.monotonic()
            fitness = _fitness(grounds, search, plan.instances)
            search.tell(fitness)
            row = {"number": search.done, "fitness": float(fitness.mean()), "spread": float(fitness.std())}
            log.add(search.done, {**row, "seconds": time.monotonic() - began_iteration_s})
            if search.done % plan.validate_every == 0:
                validate()
                validated = search.done
    except KeyboardInterrupt:
        interrupted = True
    if validated < search.done:
        validate()
    draw_curves([out], out / CURVE)
    return result()


def validation(judges: Sequence[TrainingInstance], parameters: Array) -> float:
    """Mean normalised score of the shifts of the judges' own seeds."""
    scores = [(rewards(judge, parameters[None], [judge.seed])[0] - judge.random) / judge.unit for judge in judges]
    return float(np.mean(scores))


def _fitness(grounds: Sequence[TrainingInstance], search: Evolution, count: int) -> Array:
    """Mean reward of every sample over the span of the instance, on shifts that all samples share, [sample].

    Large fleets are drawn less often, as their shifts take longer.
    """
    rng = np.random.default_rng(np.random.SeedSequence([search.config.seed, 2, search.done]))
    weights = np.array([max(ground.arms, 4.0) ** -2 for ground in grounds])
    chosen = rng.choice(len(grounds), size=min(count, len(grounds)), replace=False, p=weights / weights.sum())
    samples, total = search.ask(), np.zeros(search.config.samples)
    for index in chosen.tolist():
        ground, seed = grounds[index], int(rng.integers(2**31))
        unit = max(ground.unit, LEAST_SPAN * ground.value(ground.seed))
        scores = rewards(ground, samples, [seed] * len(samples)) / unit
        total += np.maximum(scores, scores.max() - MOST_LOSS)
    return total / len(chosen)


def draw_curves(folders: Sequence[Path], picture: Path) -> None:
    """Plot the validation of trainings against the iteration, with the line of their teacher."""
    from matplotlib.figure import Figure  # without a display

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    teacher = 0.0
    for folder in folders:
        judged = [row for row in read_log(folder) if "validation" in row]
        teacher = judged[0]["teacher"]
        axes.plot([r["iteration"] for r in judged], [r["validation"] for r in judged], "o-", ms=3, label=folder.name)
    axes.axhline(teacher, color="k", lw=1, ls="--", label="wsept")
    axes.set_xlabel("iteration")
    axes.set_ylabel("normalised score, validation")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    with atomic_path(picture) as draft:
        figure.savefig(draft, dpi=120, format="png")
