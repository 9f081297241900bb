"""Compute the sections of a twin report in parallel, and cache each as soon as it is finished.

A cached section is used again while arm, sizes, seeds and the code that made it are unchanged.
"""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar  # Any: JSON values

import msgspec
import numpy as np
from joblib import delayed

import fleet
import scenarios
import twin
from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.processes import worker_processes
from scenarios.progress import COUNTED, Progress, quiet
from scenarios.show.page import Section

log = logging.getLogger(__name__)

LIBRARIES = ("numpy", "scipy", "scikit-learn", "torch", "mujoco", "matplotlib")
"""Libraries whose versions may change figures and pictures."""
Subject = TypeVar("Subject")
"""What the chapters of a report work on."""


@dataclass(frozen=True)
class Chapter(Generic[Subject]):
    """How to compute one section of a report."""

    key: str
    title: str
    compute: Callable[[Subject], Section]
    load: float = 1.0
    """Computing time relative to other chapters; the longest group starts first."""
    group: str = ""
    """Chapters of one group share results, so they run one after the other in one process."""


@dataclass(frozen=True)
class SectionCache:
    """Finished sections, named by everything they depend on."""

    folder: Path
    basis: str
    """Hash of the inputs; see `basis`."""

    def read(self, key: str) -> Section | None:
        """The cached section, or None."""
        try:
            return msgspec.json.decode(self._path(key).read_bytes(), type=Section)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            log.warning("The cached section '%s' cannot be used (%s); computing it again.", key, error)
            return None

    def write(self, section: Section) -> None:
        """Cache a section; a failing disk is only logged."""
        path = self._path(section.key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as draft:
                draft.write_bytes(msgspec.json.encode(replace(section, numbers=plain(section.numbers))))
        except OSError as error:
            log.warning("The section '%s' cannot be cached (%s).", section.key, error)

    def _path(self, key: str) -> Path:
        return self.folder / "sections" / f"{self.basis}-{key}.json"


def basis(*inputs: object) -> str:
    """Hash of plain inputs, of this project's code and of the libraries' versions.

    Args:
        inputs: Values that msgspec can encode: dataclasses, tuples, numbers, text.
    """
    digest = hashlib.sha256(msgspec.json.encode([inputs, [version(name) for name in LIBRARIES]]))
    for package in (fleet, scenarios, twin):
        root = Path(package.__path__[0])
        for file in sorted(root.rglob("*")):
            if file.suffix in (".py", ".json", ".toml"):
                digest.update(f"{file.relative_to(root)}".encode() + file.read_bytes())
    return digest.hexdigest()[:20]


def compute_sections(
    chapters: Sequence[Chapter[Subject]],
    subject: Subject,
    *,
    cache: SectionCache | None = None,
    processes: int = 1,
    progress: Progress = quiet,
) -> list[Section]:
    """Every chapter's section, in order; one that cannot be computed is a section that says why.

    Args:
        subject: What the chapters work on; pickled for several processes.
        progress: Called after each group of sections.
    """
    done = {each.key: section for each in chapters if cache and (section := cache.read(each.key))}
    groups: dict[str, list[Chapter[Subject]]] = {}
    for each in chapters:
        if each.key not in done:
            groups.setdefault(each.group or each.key, []).append(each)
    ordered = sorted(groups.values(), key=lambda group: -sum(each.load for each in group))
    loads = {each.key: each.load for group in ordered for each in group}
    finished = 0.0
    progress("sections", 0.0)
    with worker_processes(max(1, min(processes, len(ordered)))) as pool:
        results = pool(delayed(_compute)(group, subject, cache) for group in ordered)
        for section in (section for sections in results for section in sections or ()):
            done[section.key] = section
            finished += loads[section.key]
            stage = f"{COUNTED}sections, {len(done)} of {len(chapters)} done: {section.title}"
            progress(stage, finished / sum(loads.values()))
    return [done[each.key] for each in chapters]


def _compute(group: Sequence[Chapter[Subject]], subject: Subject, cache: SectionCache | None) -> list[Section]:
    sections = []
    for chapter in group:
        try:
            section = replace(chapter.compute(subject), key=chapter.key, title=chapter.title)
            if cache is not None:
                cache.write(section)
        except (FleetError, ValueError) as error:
            section = Section(key=chapter.key, title=chapter.title, failed=f"{error}")
        sections.append(section)
    return sections


def plain(value: Any) -> Any:  # JSON
    """Plain JSON values: NaN becomes null, NumPy scalars and arrays become numbers and lists."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
