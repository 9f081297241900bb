"""The same episode on every Python of this machine that has the libraries of the environment.

PYTHON3_12=/path/to/python names one that is not on the path, for example of a virtual environment.
"""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSIONS = [each.rpartition(" ")[2] for each in PROJECT["classifiers"] if " 3." in each]
"""That the classifiers name."""
RUNNING = f"{sys.version_info.major}.{sys.version_info.minor}"
LIBRARIES = "daqp, gymnasium, mink, msgspec, mujoco, networkx, numba, numpy, pettingzoo, ruckig, safetensors, scipy"
EPISODE = """
import hashlib
import numpy as np
from scenarios import make_env

env, rng, digest = make_env("quickstart", horizon_s=1800), np.random.default_rng(0), hashlib.sha256()
seen, _ = env.reset(seed=20)
while env.agents:
    legal = {arm: np.flatnonzero(seen[arm]["action_mask"]) for arm in env.agents}
    seen, rewards, *_ = env.step({arm: int(rng.choice(actions)) for arm, actions in legal.items()})
    for arm, observed in seen.items():
        digest.update(f"{arm} {rewards[arm]!r}".encode() + observed["observation"].tobytes())
print(digest.hexdigest())
"""


def play(python: str, cache: Path) -> str:
    """Digest of the observations and rewards of the episode."""
    env = os.environ | {"PYTHONPATH": str(ROOT), "THERMOFLEET_CACHE": str(cache)}
    ran = subprocess.run([python, "-c", EPISODE], capture_output=True, text=True, timeout=1800, env=env, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_the_running_python_is_one_that_the_classifiers_name() -> None:
    assert RUNNING in VERSIONS
    assert PROJECT["requires-python"] == f">={VERSIONS[0]}"


@pytest.mark.slow
@pytest.mark.parametrize("version", [version for version in VERSIONS if version != RUNNING])
def test_another_python_plays_the_same_episode(version: str, tmp_path: Path) -> None:
    variable = f"PYTHON{version.replace('.', '_')}"
    python = os.environ.get(variable) or shutil.which(f"python{version}")
    if python is None:
        pytest.skip(f"there is no Python {version} on this machine; name one by {variable}")
    imports = subprocess.run([python, "-c", f"import {LIBRARIES}"], capture_output=True, text=True, check=False)
    if imports.returncode:
        pytest.skip(f"{python} lacks a library; name another by {variable}: {imports.stderr.strip()}")
    assert play(python, tmp_path) == play(sys.executable, tmp_path)
