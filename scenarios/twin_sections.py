"""Sections of a twin report: computed side by side, and each kept as soon as it is finished.

A kept section is used again while arm, sizes, seeds and the code that made it are unchanged.
"""

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from joblib import Parallel, delayed

import fleet
import scenarios
import twin
from fleet.errors import FleetError
from scenarios.build import Progress, quiet
from scenarios.terminal import COUNTED
from scenarios.twin_page import Section

log = logging.getLogger(__name__)

Chapter = Callable[[Any], Section]
LIBRARIES = ("numpy", "scipy", "scikit-learn", "torch", "mujoco", "matplotlib")
"""On whose versions figures and pictures may depend."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One chapter of a report."""

    key: str
    title: str
    chapter: Chapter
    group: str = ""
    """Chapters of one group share what they compute, so they follow one another in one process."""
    load: float = 1.0
    """How long it takes compared with others; the longest group begins first."""

    @property
    def together(self) -> str:
        """The group, or the chapter itself."""
        return self.group or self.key


@dataclass(frozen=True)
class Shelf:
    """Finished sections, named by all that they depend on."""

    folder: Path
    basis: str
    """Hash of the inputs; see `basis`."""

    def read(self, key: str) -> Section | None:
        """The kept section, None where there is none that can be read."""
        try:
            return msgspec.json.decode(self._home(key).read_bytes(), type=Section)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            log.warning("The kept section '%s' cannot be used (%s); computing it anew.", key, error)
            return None

    def keep(self, section: Section) -> None:
        """Keep it whole or not at all; a disk that refuses costs the repetition, not the report."""
        data = msgspec.json.encode(replace(section, numbers=plain(section.numbers)))
        home = self._home(section.key)
        try:
            home.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=home.parent, delete=False) as file:
                file.write(data)
            os.replace(file.name, home)
        except OSError as error:
            log.warning("The section '%s' cannot be kept (%s).", section.key, error)

    def _home(self, key: str) -> Path:
        return self.folder / "sections" / f"{self.basis}-{key}.json"


def basis(*inputs: Any) -> str:
    """Hash of plain inputs, of this project's code and of the libraries' versions.

    Args:
        inputs: What msgspec can encode: dataclasses, tuples, numbers, text.
    """
    digest = hashlib.sha256(msgspec.json.encode([inputs, [version(name) for name in LIBRARIES]]))
    for package in (fleet, scenarios, twin):
        root = Path(package.__path__[0])
        for file in sorted(root.rglob("*")):
            if file.suffix in (".py", ".json", ".toml"):
                digest.update(f"{file.relative_to(root)}".encode() + file.read_bytes())
    return digest.hexdigest()[:20]


def computed(
    entries: Sequence[Entry],
    subject: Any,
    *,
    shelf: Shelf | None = None,
    processes: int = 1,
    progress: Progress = quiet,
) -> list[Section]:
    """Every chapter's section, in order; one that cannot be computed is a section that says why.

    Args:
        subject: What the chapters work on; pickled where there are several processes.
        shelf: Where finished sections are kept, and found again.
        progress: Told of each section as it begins; where they are computed side by side, as it ends.
    """
    found = {entry.key: section for entry in entries if shelf and (section := shelf.read(entry.key))}
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        if entry.key not in found:
            groups.setdefault(entry.together, []).append(entry)
    ordered = sorted(groups.values(), key=lambda group: -sum(entry.load for entry in group))
    total, done = sum(entry.load for group in ordered for entry in group), 0.0
    if processes > 1 and len(ordered) > 1:
        progress("sections", 0.0)
        with Parallel(n_jobs=min(processes, len(ordered)), return_as="generator_unordered") as pool:
            for sections in pool(delayed(_group)(group, subject, shelf) for group in ordered):
                assert sections is not None
                for section in sections:
                    found[section.key] = section
                    done += next(entry.load for entry in entries if entry.key == section.key)
                    progress(f"{COUNTED}sections, {len(found)} of {len(entries)} done: {section.title}", done / total)
    else:
        for entry in (entry for group in ordered for entry in group):
            progress(f"{COUNTED}section {len(found) + 1} of {len(entries)}: {entry.title}", done / total)
            found[entry.key] = _section(entry, subject, shelf)
            done += entry.load
    return [found[entry.key] for entry in entries]


def _group(group: Sequence[Entry], subject: Any, shelf: Shelf | None) -> list[Section]:
    return [_section(entry, subject, shelf) for entry in group]


def _section(entry: Entry, subject: Any, shelf: Shelf | None) -> Section:
    try:
        section = entry.chapter(subject)
    except (FleetError, ValueError) as error:
        return Section(key=entry.key, title=entry.title, failed=f"{error}")
    if shelf is not None:
        shelf.keep(section)
    return section


def plain(value: Any) -> Any:
    """The same with what JSON lacks left out: NaN becomes null, numpy's numbers and arrays those of Python."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
