"""Plans on disk, by content: the same arm, place and work is planned once."""

import hashlib
import json
import logging
import os
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fleet.errors import InfeasibleJob
from fleet.job import Work
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.robot import GEN3, Robot
from fleet.sim.description import ELBOW_ANGLES_DEG, GRAVITY_M_S2, gen3_xml
from fleet.sim.itinerary import GRASP_S

Array = np.ndarray
log = logging.getLogger(__name__)

PLANNER_VERSION = 1
"""Raised whenever the same question would get another answer."""
_BROKEN_FILE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


class PlanCache:
    """A folder of plan sets, one file each; written to a temporary name and renamed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._model_hash = hashlib.sha256(gen3_xml()).hexdigest()

    def key(self, robot: Robot, work: Work, *, elbows: int, speeds: tuple[float, ...]) -> str:
        """Hash of everything that shapes a plan; the arm's name and its heat do not."""
        content = {
            "planner": PLANNER_VERSION,
            "rate_hz": RATE_HZ,
            "limits": asdict(GEN3),
            **self._arm(robot),
            "work": asdict(work),
            "grasp_s": GRASP_S,
            "elbow_angles_deg": ELBOW_ANGLES_DEG,
            "elbows": elbows,
            "speeds": speeds,
        }
        return _hash(content)

    def rest_key(self, robot: Robot) -> str:
        """Hash of everything that shapes the torque which holds an arm at home."""
        return _hash({"what": "torque at home", **self._arm(robot)})

    def load_rest(self, key: str) -> Array | None:
        """The torque that holds the arm at home as it was stored, N·m, [joint]; None if it was not."""
        try:
            with self._path(key).open("rb") as file, np.load(file, allow_pickle=False) as stored:
                return stored["rest_tau"]
        except _BROKEN_FILE:
            return None

    def store_rest(self, key: str, rest_tau: Array) -> None:
        """Keep it."""
        self._write(key, rest_tau=rest_tau)

    def _arm(self, robot: Robot) -> dict[str, object]:
        """What shapes the torques of an arm."""
        return {
            "model": self._model_hash,
            "gravity": GRAVITY_M_S2,
            "mount": asdict(robot.mount),
            "home": robot.home_q().tolist(),
            "tool_kg": robot.tool_kg,
        }

    def load(self, key: str, arm: str, work: Work) -> tuple[Plan, ...] | InfeasibleJob | None:
        """What was stored, made out to this arm and work; None if nothing was, or if the file is broken."""
        path = self._path(key)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                if "infeasible" in stored:
                    place, reason = stored["infeasible"].tolist()
                    return InfeasibleJob(arm, place, reason)
                return _unpack(
                    stored["profile"], stored["payload_kg"], stored["lengths"], stored["variants"], arm, work
                )
        except FileNotFoundError:
            return None
        except _BROKEN_FILE as error:
            log.warning("Plan file %s cannot be read (%s); planning anew.", path, error)
            return None

    def store(self, key: str, plans: tuple[Plan, ...]) -> None:
        """Keep a plan set."""
        phases = [phase for plan in plans for phase in plan.phases]
        self._write(
            key,
            profile=np.concatenate([phase.profile for phase in phases]),
            payload_kg=np.concatenate([phase.payload_kg for phase in phases]),
            lengths=np.array([[len(phase.profile) for phase in plan.phases] for plan in plans]),
            variants=np.array([(plan.elbow, plan.speed) for plan in plans]),
        )

    def store_infeasible(self, key: str, error: InfeasibleJob) -> None:
        """Keep the knowledge that there is no plan."""
        self._write(key, infeasible=np.array([error.place, error.reason]))

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.npz"

    def _write(self, key: str, **arrays: Array) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=self._folder, prefix=f"{key}.", suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, allow_pickle=False, **arrays)
            os.replace(temporary, self._path(key))
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise


def _hash(content: dict[str, object]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def _unpack(
    profile: Array, payload_kg: Array, lengths: Array, variants: Array, arm: str, work: Work
) -> tuple[Plan, ...]:
    """Plans from their samples end to end, the lengths [plan, phase] and (elbow, speed) [plan, 2]."""
    if lengths.sum() != len(profile) or len(lengths) != len(variants):
        raise ValueError(f"{lengths.sum()} samples announced, {len(profile)} stored")
    ends = np.cumsum(lengths.ravel())[:-1]
    phases = iter(map(Phase, np.split(profile, ends), np.split(payload_kg, ends)))
    return tuple(
        Plan(arm, work, int(elbow), float(speed), next(phases), next(phases), next(phases)) for elbow, speed in variants
    )
