"""The folders are the theory: what may import what, read from the source itself."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("fleet", "twin", "agents", "scenarios")
SOURCES = sorted(path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

LAWS = ("motor", "thermal", "motion", "aging", "drift")
NOUNS_OF_LAWS = ("robot", "job", "errors")
"""Nouns without which no law could be written down: how many joints, what work, which errors."""

SIM_LIBRARIES = ("mujoco", "mink", "ruckig")
TRAINERS = ("agilerl", "benchmarl", "ray", "sb3_contrib", "stable_baselines3", "tianshou")
TENSORS = ("torch", "torchrl", "tensordict")
HEAVY = ("torch", "mujoco", "zenoh")


def name_of(path: Path) -> str:
    """`fleet/sim/__init__.py` is `fleet.sim`."""
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path) for path in SOURCES}
NOUNS = {name for name in MODULES if name.count(".") == 1 and name.startswith("fleet.")} - {
    "fleet.sim",
    "fleet.env",
    "fleet.bus",
    "fleet.live",
}


def imports(path: Path) -> Iterator[str]:
    """Full names of the modules that a source file imports, wherever in the file."""
    package = name_of(path) if path.name == "__init__.py" else name_of(path).rpartition(".")[0]
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*up, *filter(None, [node.module])])
            for alias in node.names:
                deeper = f"{base}.{alias.name}"
                yield deeper if deeper in MODULES else base


def below(name: str, *parents: str) -> bool:
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


def allowed(importer: str, imported: str) -> bool:
    """Whether a module of ours may import another one of ours."""
    if below(importer, "scenarios"):
        return True
    if below(importer, "twin"):
        return below(imported, "twin") or imported in NOUNS
    if below(importer, "agents"):
        return below(imported, "agents") or imported in NOUNS or imported == "fleet.env.observation"
    if below(importer, "fleet.env"):
        return below(imported, "fleet.env", "fleet.sim", "fleet.bus.exchange", "fleet.bus.memory") or imported in NOUNS
    if below(importer, "fleet.sim"):
        return below(imported, "fleet.sim") or imported in NOUNS
    if below(importer, "fleet.live"):
        return below(imported, "fleet.live", "fleet.bus", "fleet.sim") or imported in NOUNS
    if below(importer, "fleet.bus"):
        return below(imported, "fleet.bus") or imported in NOUNS
    if importer.removeprefix("fleet.") in LAWS:
        return imported.removeprefix("fleet.") in (*LAWS, *NOUNS_OF_LAWS)
    return imported in NOUNS


def library_allowed(importer: str, library: str) -> bool:
    """Whether a module of ours may import a library that is kept in one place."""
    if library in SIM_LIBRARIES:
        return below(importer, "fleet.sim")
    if library == "zenoh":
        # ros2: other keys, bytes and attachments than ours, which `Link` knows nothing of.
        return importer in (
            "fleet.bus.session",
            "fleet.bus.seat",
            "fleet.bus.router",
            "fleet.bus.link",
            "fleet.bus.ros2",
        )
    if library == "rosbags":
        return importer == "fleet.bus.ros2_cdr"
    if library in TRAINERS:
        return below(importer, "fleet.env.adapters")
    if library in TENSORS:
        return below(importer, "agents.learned", "fleet.env.adapters") or (
            library == "torch" and below(importer, "twin")
        )
    return True


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_every_import_follows_the_arrows(path):
    importer = name_of(path)
    ours = [name for name in imports(path) if below(name, *PACKAGES)]
    assert [name for name in ours if not allowed(importer, name)] == []


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_each_library_stays_in_its_place(path):
    libraries = {name.partition(".")[0] for name in imports(path)}
    assert [library for library in libraries if not library_allowed(name_of(path), library)] == []


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("fleet.job", "twin.score"),
        ("fleet.sim.kernel", "agents.rules"),
        ("fleet.motion", "fleet.difficulty"),
        ("fleet.thermal", "fleet.sim.state"),
        ("fleet.job", "fleet.bus.keys"),
        ("fleet.sim.kernel", "fleet.env.reward"),
        ("fleet.sim.kernel", "fleet.bus.memory"),
        ("fleet.bus.memory", "fleet.sim.state"),
        ("fleet.env.allocation_v0", "fleet.bus.session"),
        ("agents.rules", "fleet.sim.state"),
        ("agents.rules", "fleet.env.allocation_v0"),
        ("agents.rules", "twin.score"),
        ("twin.score", "agents.rules"),
        ("twin.score", "fleet.sim.oracle"),
        ("twin.score", "scenarios.build"),
    ],
)
def test_the_wrong_way_is_seen(importer, imported):
    assert not allowed(importer, imported)


@pytest.mark.parametrize(
    ("importer", "library"),
    [
        ("scenarios.build", "mujoco"),
        ("fleet.bus.memory", "zenoh"),
        ("agents.rules", "torch"),
        ("fleet.env.x", "mink"),
        ("fleet.bus.ros2", "rosbags"),
        ("fleet.env.allocation_v0", "ray"),
        ("agents.learned.train", "stable_baselines3"),
        ("fleet.env.vector", "torch"),
        ("twin.train", "torchrl"),
    ],
)
def test_a_library_out_of_its_place_is_seen(importer, library):
    assert not library_allowed(importer, library)


def test_imports_are_found_in_every_form(tmp_path, monkeypatch):
    (tmp_path / "agents").mkdir()
    late = "def late():\n    from .rules import RULES\n    from . import policy\n"
    source = f"import torch.nn as nn\nfrom fleet import job\n{late}"
    (tmp_path / "agents" / "probe.py").write_text(source, encoding="utf-8")
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    assert set(imports(Path("agents/probe.py"))) == {"torch.nn", "fleet.job", "agents.rules", "agents.policy"}


@pytest.mark.parametrize("path", [path for path in SOURCES if path.name == "__init__.py"], ids=str)
def test_a_package_file_holds_a_docstring_and_at_most_its_public_door(path):
    docstring, *rest = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
    assert isinstance(docstring, ast.Expr)
    assert isinstance(docstring.value, ast.Constant)
    for statement in rest:
        if isinstance(statement, ast.ImportFrom) and statement.level:
            assert all(alias.asname == alias.name for alias in statement.names)
        else:  # doors that open when they are used
            assert path == Path("scenarios/__init__.py")
            assert isinstance(statement, ast.Import | ast.ImportFrom) or ast.unparse(statement).startswith(
                ("if TYPE_CHECKING:", "__all__ =", "def __getattr__(", "if 'pettingzoo' in sys.modules:")
            )


def loaded_by(*modules: str) -> set[str]:
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    return set(said.stdout.split())


@pytest.mark.parametrize(
    "modules",
    [["fleet"], sorted(NOUNS), ["fleet.bus.memory"], ["fleet.env.observation"], ["agents.rules"], ["scenarios.cli"]],
    ids=["fleet", "nouns", "memory", "observation", "rules", "command line"],
)
def test_what_is_light_loads_no_heavy_library(modules):
    assert loaded_by(*modules) & set(HEAVY) == set()


def test_nobody_but_the_root_imports_an_adapter():
    adapters = [
        (name_of(path), name) for path in SOURCES for name in imports(path) if below(name, "fleet.env.adapters")
    ]
    assert [pair for pair in adapters if not below(pair[0], "fleet.env.adapters", "scenarios")] == []


def test_every_package_is_walked():
    assert {name.partition(".")[0] for name in MODULES} == set(PACKAGES)
    assert {"fleet.job", "fleet.motor", "fleet.errors"} <= NOUNS
    assert len(SOURCES) > 40
