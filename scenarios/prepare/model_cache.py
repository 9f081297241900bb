"""Models kept on disk: loaded where they are intact, made in parallel where they are missing."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from joblib import cpu_count, delayed

from fleet.errors import CheckpointError
from scenarios.processes import worker_processes
from scenarios.progress import Count, Progress, quiet

log = logging.getLogger(__name__)

Model = TypeVar("Model")


@dataclass(frozen=True)
class CachedModel(Generic[Model]):
    """One model: its folder, whose name stands for everything the model depends on, and how to load and make it."""

    folder: Path
    load: Callable[[Path], Model]
    """Raises `CheckpointError` for damaged files."""
    make: Callable[[Path, Callable[[float], None]], str | None]
    """Make the model and save it in the folder, reporting the fraction done. Return a reason if it cannot be made;
    `load` must then handle the missing folder."""


def load_or_make(models: Sequence[CachedModel[Model]], stage: str, progress: Progress = quiet) -> list[Model]:
    """Every model: from its folder if it is there and intact, else made now, several at a time."""
    loaded = [_load_intact(model) for model in models]
    missing = [i for i, model in enumerate(loaded) if model is None]
    progress(stage, Count(len(models) - len(missing), len(models)))

    def report(made: float) -> None:
        progress(stage, Count(len(models) - len(missing) + made, len(models)))

    reasons: list[str | None] = []
    if len(missing) == 1:  # in this process, which can report progress within one model
        reasons = [models[missing[0]].make(models[missing[0]].folder, report)]
        report(1)
    elif missing:
        with worker_processes(min(len(missing), cpu_count())) as pool:
            tasks = (delayed(models[i].make)(models[i].folder, _ignore) for i in missing)
            for made, reason in enumerate(pool(tasks), start=1):
                reasons.append(reason)
                report(made)
    for reason in filter(None, reasons):
        log.warning("%s", reason)
    return [model.load(model.folder) if ready is None else ready for model, ready in zip(models, loaded, strict=True)]


def _load_intact(model: CachedModel[Model]) -> Model | None:
    if not model.folder.is_dir():
        return None
    try:
        return model.load(model.folder)
    except CheckpointError as error:
        log.warning("A cached model is damaged (%s); making it again.", error)
        return None


def _ignore(_fraction: float) -> None:
    pass
