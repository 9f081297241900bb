"""Plans and models of scenarios that come with the package, as files of the cache, so that nothing is computed.

An archive is `SCENARIO-KEY.tar.xz`; the key is a hash of the scenario's file, and of the code and data from which plans
and models follow. For other code there is no archive, and everything is computed.
`python -m benchmarks.ship_prepared` makes the archives anew.
"""

import hashlib
import tarfile
from functools import cache
from importlib.resources import files
from pathlib import Path

from fleet.files import atomic_path

_ROOT = Path(str(files("scenarios"))).parent
FOLDER = _ROOT / "scenarios" / "prepare" / "archives"
SCENARIOS = ("quickstart",)
"""Scenarios of the library that have an archive."""
_SOURCES = {
    "fleet": ("difficulty", "job", "motion", "offered_plans", "robot"),
    "fleet/arm": (
        *("clearance", "gen3", "kinematics", "model", "own_frame", "plan_cache", "planner", "random_motions", "space"),
        *("task_phases", "trajectory"),
    ),
    "fleet/heat": ("motor", "thermal"),
    "scenarios/prepare": ("arms", "calibrate", "oracle", "twins"),
    "twin/logs": ("recording",),
    "twin/thermal": ("checkpoint", "identify", "thermal_twin"),
    "twin/vae": ("config", "inference", "measures", "model", "train", "twin", "window"),
}
"""Modules by folder; the engine takes no part."""
_DATA = ("fleet/arm/assets/gen3.xml", "fleet/data/gen3_thermal.json")


@cache
def archive_of(scenario: str) -> Path:
    """Archive of a scenario of the library for the present code, whether it exists or not."""
    sources = [f"{folder}/{name}.py" for folder, names in _SOURCES.items() for name in names]
    digest = hashlib.sha256()
    for path in (f"scenarios/library/{scenario}.toml", *_DATA, *sources):
        content = (_ROOT / path).read_bytes()
        digest.update(f"{path} {len(content)}\n".encode() + content)
    return FOLDER / f"{scenario}-{digest.hexdigest()[:16]}.tar.xz"


def is_shipped(scenario: str) -> bool:
    """Whether the package has plans and models of a scenario of this name, computed by the present code."""
    return scenario in SCENARIOS and archive_of(scenario).is_file()


def unpack_shipped(scenario: str, folder: Path) -> None:
    """Put the shipped plans and models of a scenario, if any, into a cache folder, once.

    They replace plans that another scenario with the same arms has left: on another processor those differ by rounding,
    and models are looked up by the plans.
    """
    if not is_shipped(scenario):
        return
    archive = archive_of(scenario)
    unpacked = folder / "shipped" / archive.name
    if unpacked.exists():
        return
    unpacked.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(archive) as packed:
        for member in packed:
            path, content = folder / member.name, packed.extractfile(member)
            if content is None:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as draft:
                draft.write_bytes(content.read())
    unpacked.touch()
