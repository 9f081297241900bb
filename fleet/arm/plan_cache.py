"""Plans and home torques of one arm, cached on disk by content; MuJoCo is loaded only for missing ones."""

import hashlib
import json
import logging
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from fleet.arm.gen3 import ELBOW_ANGLES_DEG, GRAVITY_M_S2, gen3_xml
from fleet.arm.own_frame import ARM, OwnFrame
from fleet.arm.task_phases import GRASP_S
from fleet.errors import InfeasibleJob
from fleet.files import atomic_path
from fleet.job import Fixture, Work
from fleet.motion import RATE_HZ, Phase, Plan, distinct, stored_once
from fleet.robot import GEN3, RATING, Robot

if TYPE_CHECKING:
    from fleet.arm.planner import Planner


Array = np.ndarray
T = TypeVar("T")
log = logging.getLogger(__name__)

_written: dict[Path, int] = {}
"""Bytes that this process wrote to a folder since it last listed its files, by folder."""

RANDOM_MOTIONS_VERSION = 2
"""Version of `fleet.arm.random_motions`; increment it when the same seed gives other motions."""
PLANNER_VERSION = 4
"""Increment it whenever the plans of the same work change."""
MAX_CACHE_BYTES = 2_000_000_000
"""Size of all files in a folder; beyond it the least recently used ones are removed."""
LOOK_EVERY = 0.01
"""Share of these bytes that a process writes before it lists all files again."""
MAX_SAMPLES = 1_000_000
"""Samples of one phase in a file; a longer phase counts as damage."""


LoadedPlans = dict[Path, tuple[Plan, ...] | InfeasibleJob]
"""Content of files of plans."""


class CachedPlanner:
    """A `fleet.arm.planner.Planner` with the same arguments that computes each set of plans once.

    Like arms have the same plans (`fleet.arm.own_frame`).
    """

    def __init__(
        self,
        robot: Robot,
        fixtures: Sequence[Fixture] = (),
        *,
        elbows: int = 3,
        speeds: tuple[float, ...] = (1.0, 0.6),
        cache_dir: Path,
        loaded: LoadedPlans | None = None,
    ) -> None:
        """Load nothing yet.

        Args:
            loaded: Loaded plans in memory, shared by the planners of equal arms; None: not kept.
        """
        self._loaded = loaded
        self._name, self._frame = robot.name, OwnFrame(robot.mount)
        self._robot, self._fixtures = self._frame.robot(robot), self._frame.fixtures(fixtures)
        self._elbows, self._folder = elbows, cache_dir
        self._speeds = tuple(sorted(set(speeds), reverse=True))
        self._planner: Planner | None = None

    def plan(self, work: Work) -> tuple[Plan, ...]:
        """All variants, as `Planner.plan`.

        Raises:
            InfeasibleJob: there is none.
        """
        own = self._frame.work(work)
        key = {
            "planner": PLANNER_VERSION,
            "rate_hz": RATE_HZ,
            "limits": asdict(GEN3),
            "rating": asdict(RATING),
            "payload_limit_kg": self._robot.payload_limit_kg,
            **_torque_key(self._robot),
            "work": asdict(own),
            "grasp_s": GRASP_S,
            "elbow_angles_deg": ELBOW_ANGLES_DEG,
            "elbows": self._elbows,
            "speeds": self._speeds,
        }
        if self._fixtures:
            key["fixtures"] = [asdict(fixture) for fixture in self._fixtures]
        path = _path(self._folder, key)
        plans = self._loaded.get(path) if self._loaded else None
        plans = plans or _read(path, lambda arrays: _unpack(arrays, own))
        if plans is None:
            plans = self._compute(own)
            _write(path, _pack(plans))
        if self._loaded is not None:
            self._loaded[path] = plans
        if isinstance(plans, InfeasibleJob):
            place = work.places[int(plans.place)].name
            raise InfeasibleJob(self._name, place, plans.reason, too_heavy=plans.too_heavy)
        return tuple(replace(plan, arm=self._name, work=work) for plan in plans)

    def _compute(self, work: Work) -> tuple[Plan, ...] | InfeasibleJob:
        if self._planner is None:
            from fleet.arm.planner import Planner

            self._planner = Planner(self._robot, self._fixtures, elbows=self._elbows, speeds=self._speeds)
        try:
            return self._planner.plan(work)
        except InfeasibleJob as error:
            return error


def rest_torque(robot: Robot, cache_dir: Path) -> Array:
    """Torque that holds an arm at home, N·m, [joint]."""

    def compute() -> dict[str, Array]:
        from fleet.arm.model import ArmModel

        return {"rest_tau": ArmModel(robot).gravity_torque(robot.home_q())}

    return cached_arrays(cache_dir, {"what": "torque at home", **_torque_key(robot)}, compute)["rest_tau"]


def cached_arrays(
    folder: Path, key: dict[str, object], compute: Callable[[], Mapping[str, Array]]
) -> Mapping[str, Array]:
    """The arrays that are stored under a key; computed and stored if there are none."""
    path = _path(folder, key)
    arrays = _read(path, dict)
    if arrays is None:
        arrays = compute()
        _write(path, arrays)
    return arrays


def _torque_key(robot: Robot) -> dict[str, object]:
    """All that determines the torques of an arm."""
    return {
        "model": hashlib.sha256(gen3_xml()).hexdigest(),
        "gravity": GRAVITY_M_S2,
        "mount": asdict(robot.mount),
        "home": robot.home_q().tolist(),
        "tool_kg": robot.tool_kg,
    }


def _path(folder: Path, key: dict[str, object]) -> Path:
    return folder / f"{hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:32]}.npz"


def _read(path: Path, unpack: Callable[[Mapping[str, Array]], T]) -> T | None:
    """The content of a file; None if there is no file, or if it is damaged."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            content = unpack(arrays)
        with suppress(OSError):
            os.utime(path)  # the time of its last use
        return content
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        log.warning("Cannot read plan file %s (%s); planning again.", path, error)
        return None


def _write(path: Path, arrays: Mapping[str, Array]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as draft, draft.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    written = _written.get(path.parent, MAX_CACHE_BYTES) + path.stat().st_size
    if written > LOOK_EVERY * MAX_CACHE_BYTES:
        _remove_oldest(path.parent)
        written = 0
    _written[path.parent] = written


def _remove_oldest(folder: Path) -> None:
    """Remove the least recently used files of a folder that is too large; other processes may do so at once."""
    files: list[tuple[float, int, str]] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):
                if entry.name.endswith(".npz"):
                    status = entry.stat()
                    files.append((status.st_mtime, status.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files)[:-1]:
        if total <= MAX_CACHE_BYTES:
            break
        with suppress(OSError):
            os.unlink(path)
        total -= size


def _pack(plans: tuple[Plan, ...] | InfeasibleJob) -> dict[str, Array]:
    if isinstance(plans, InfeasibleJob):
        return {"infeasible": np.array([plans.place, plans.reason, "too heavy" if plans.too_heavy else ""])}
    stored = [[distinct(phase.profile) for phase in plan.phases] for plan in plans]
    counts = [[len(part) for part in parts] for parts in stored]
    loads = [
        phase.payload_kg[: len(part)]
        for p, s in zip(plans, stored, strict=True)
        for phase, part in zip(p.phases, s, strict=True)
    ]
    return {
        "profile": np.concatenate([part for parts in stored for part in parts]),
        "payload_kg": np.concatenate(loads),
        "lengths": np.array([[len(phase.profile) for phase in plan.phases] for plan in plans]),
        "stored": np.array(counts),
        "variants": np.array([(plan.elbow, plan.speed) for plan in plans]),
    }


def _phase(length: int, profile: Array, payload_kg: Array) -> Phase:
    """Phase of stored samples: all of them, or one to which all are equal."""
    if len(profile) < length:
        profile = np.broadcast_to(profile[0], (length, *profile.shape[1:]))
        payload_kg = np.broadcast_to(payload_kg[0], (length,))
    return stored_once(Phase(profile, payload_kg))


def _unpack(arrays: Mapping[str, Array], work: Work) -> tuple[Plan, ...] | InfeasibleJob:
    """The inverse of `_pack`, for this work and a nameless arm."""
    if "infeasible" in arrays:
        place, reason, load = arrays["infeasible"].tolist()
        return InfeasibleJob(ARM, place, reason, too_heavy=bool(load))
    profile, lengths, variants = arrays["profile"], arrays["lengths"], arrays["variants"]
    stored = arrays.get("stored", lengths)
    if stored.sum() != len(profile) or len(lengths) != len(variants) or stored.shape != lengths.shape:
        raise ValueError(f"its {len(lengths)} plans have {stored.sum()} samples in all, but {len(profile)} are stored")
    if not ((stored == lengths) | (stored == 1)).all() or lengths.max() > MAX_SAMPLES:
        raise ValueError("the stored samples do not fit the lengths of the phases")
    ends = np.cumsum(stored.ravel())[:-1]
    parts = zip(lengths.ravel(), np.split(profile, ends), np.split(arrays["payload_kg"], ends), strict=True)
    phases = iter([_phase(int(length), *part) for length, *part in parts])
    return tuple(
        Plan(ARM, work, int(elbow), float(speed), next(phases), next(phases), next(phases)) for elbow, speed in variants
    )
