"""Which module may import which, read from the source itself."""

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import networkx as nx

ROOT = Path(__file__).parents[1]
PACKAGES = ("fleet", "twin", "agents", "scenarios")
SOURCES = sorted(path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
LAWS = ("heat.motor", "heat.thermal", "motion")
NOUNS_OF_LAWS = ("robot", "job", "errors", "jit")
"""What laws need besides: the number of joints, the kinds of work, the errors, and compilation."""

SIM_LIBRARIES = ("mujoco", "mink", "ruckig")
TRAINERS = ("agilerl", "benchmarl", "ray", "sb3_contrib", "stable_baselines3", "tianshou")
NEIGHBOURS = {"rosbags": "fleet.ros2.cdr", "rclpy": "fleet.ros2.job_action"}
"""Libraries of other systems, each in one module."""
TENSORS = ("torch", "torchrl", "tensordict")
HEAVY = ("torch", "mujoco", "zenoh")


def name_of(path: Path) -> str:
    """`fleet/engine/__init__.py` is `fleet.engine`."""
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path) for path in SOURCES}
NOUN_FOLDERS = (Path("fleet"), Path("fleet/heat"))
NOUNS = {name_of(path) for path in SOURCES if path.parent in NOUN_FOLDERS and path.name != "__init__.py"}
LONGEST_FILE = 900
"""Lines."""


def imports(path: Path, *, on_load: bool = False) -> tuple[str, ...]:
    """Full names of the modules that a source file imports, anywhere or only when it is loaded."""
    return read_imports(ROOT / path, name_of(path), on_load)


@cache
def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


@cache
def read_imports(file: Path, module: str, on_load: bool) -> tuple[str, ...]:
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    tree = tree_of(file)
    names = []
    for node in run_on_load(tree) if on_load else ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            up = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*up, *filter(None, [node.module])])
            deeper = [f"{base}.{alias.name}" for alias in node.names]
            names += [each if each in MODULES else base for each in deeper]
    return tuple(names)


def run_on_load(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes that run when a module is loaded: neither function bodies nor imports for type checkers."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        yield child
        yield from run_on_load(child)


def below(name: str, *parents: str) -> bool:
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


IN_MEMORY = ("fleet.bus.exchange.memory",)
BELOW = {
    "fleet.heat": (),
    "fleet.arm": ("fleet.engine",),
    "fleet.engine": IN_MEMORY,
    "fleet.bus": (),
    "fleet.env": ("fleet.engine", *IN_MEMORY),
    "fleet.live": ("fleet.bus", "fleet.engine", "fleet.arm"),
    "fleet.ros2": ("fleet.bus", "fleet.live"),
}
"""Which folders of fleet a folder of fleet may import, besides itself and the nouns."""


def allowed(importer: str, imported: str) -> bool:
    """Whether a module of ours may import another one of ours."""
    if below(importer, "scenarios"):
        return True
    if below(importer, "twin"):
        return below(imported, "twin") or imported in NOUNS
    if below(importer, "agents"):
        return below(imported, "agents") or imported in NOUNS
    folder = ".".join(importer.split(".")[:2])
    if folder in BELOW:
        return below(imported, folder, *BELOW[folder]) or imported in NOUNS
    if importer.removeprefix("fleet.") in LAWS:
        return imported.removeprefix("fleet.") in (*LAWS, *NOUNS_OF_LAWS)
    return imported in NOUNS


def library_allowed(importer: str, library: str) -> bool:
    """Whether a module of ours may import a library that is kept in one place."""
    if library in SIM_LIBRARIES:
        return below(importer, "fleet.arm")
    if library == "zenoh":
        # ros2: other keys, bytes and attachments than ours, which `BusClient` knows nothing of.
        return importer in ("fleet.bus.exchange.zenoh", "fleet.bus.router", "fleet.bus.client", "fleet.ros2.node")
    if library in NEIGHBOURS:
        return importer == NEIGHBOURS[library]
    if library in TRAINERS:
        return below(importer, "fleet.env.adapters") or (importer, library) == ("scenarios.evaluate.ray_workers", "ray")
    if library in TENSORS:
        return below(importer, "agents.learned", "fleet.env.adapters") or (
            library == "torch" and below(importer, "twin")
        )
    return True


def test_every_import_follows_the_arrows():
    imported = [(name_of(path), name) for path in SOURCES for name in imports(path) if below(name, *PACKAGES)]
    assert [pair for pair in imported if not allowed(*pair)] == []


def test_each_library_stays_in_its_place():
    libraries = {(name_of(path), name.partition(".")[0]) for path in SOURCES for name in imports(path)}
    assert sorted(pair for pair in libraries if not library_allowed(*pair)) == []


WRONG_WAYS = """
fleet.job twin.vae.twin / fleet.engine.step agents.rules / fleet.motion fleet.difficulty
fleet.heat.thermal fleet.engine.state / fleet.job fleet.bus.protocol.keys / fleet.engine.step fleet.env.vector
fleet.engine.step fleet.bus.client / fleet.bus.exchange.memory fleet.engine.state
fleet.env.allocation_v2 fleet.bus.exchange.zenoh / agents.rules fleet.engine.state
agents.rules fleet.env.allocation_v2 / agents.rules twin.vae.twin / twin.vae.twin agents.rules
twin.vae.twin scenarios.prepare.arms
"""
OUT_OF_PLACE = """
scenarios.prepare.fleet mujoco / fleet.bus.exchange.memory zenoh / agents.rules torch / fleet.env.x mink
fleet.ros2.node rosbags / fleet.env.allocation_v2 ray / agents.learned.train stable_baselines3
fleet.env.vector torch / twin.vae.train torchrl
"""


def pairs(text: str) -> list[list[str]]:
    return [pair.split() for line in text.strip().splitlines() for pair in line.split("/")]


def test_the_wrong_way_is_seen():
    assert [pair for pair in pairs(WRONG_WAYS) if allowed(*pair)] == []
    assert [pair for pair in pairs(OUT_OF_PLACE) if library_allowed(*pair)] == []


def test_imports_are_found_in_every_form(tmp_path, monkeypatch):
    (tmp_path / "agents").mkdir()
    late = "def late():\n    from .rules import RULES\n    from . import policy\n"
    typed = "if TYPE_CHECKING:\n    from fleet import robot\n"
    source = f"import torch.nn as nn\ntry:\n    from fleet import job\nfinally:\n    pass\n{typed}{late}"
    (tmp_path / "agents" / "probe.py").write_text(source, encoding="utf-8")
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    every = {"torch.nn", "fleet.job", "fleet.robot", "agents.rules", "agents.policy"}
    assert set(imports(Path("agents/probe.py"))) == every
    assert set(imports(Path("agents/probe.py"), on_load=True)) == {"torch.nn", "fleet.job"}


def more_than_public_names(path: Path) -> list[str]:
    """Statements of a package file that are neither its docstring nor the import of public names."""
    docstring, *rest = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
    wrong = [] if isinstance(docstring, ast.Expr) and isinstance(docstring.value, ast.Constant) else [docstring]
    for statement in rest:
        if isinstance(statement, ast.ImportFrom) and statement.level:
            allowed = all(alias.asname == alias.name for alias in statement.names)
        else:  # functions that are imported when they are used
            allowed = path == Path("scenarios/__init__.py") and (
                isinstance(statement, ast.Import | ast.ImportFrom)
                or ast.unparse(statement).startswith(
                    ("if TYPE_CHECKING:", "__all__ =", "def __getattr__(", "if 'pettingzoo' in sys.modules:")
                )
            )
        wrong += [] if allowed else [statement]
    return [f"{path}: {ast.unparse(statement)}" for statement in wrong]


def test_a_package_file_holds_a_docstring_and_at_most_its_public_names():
    assert [each for path in SOURCES if path.name == "__init__.py" for each in more_than_public_names(path)] == []


def loaded_by(*modules: str) -> set[str]:
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    return set(said.stdout.split())


def test_what_is_light_loads_no_heavy_library():
    assert loaded_by(*sorted(NOUNS), "fleet.bus.exchange.memory", "agents.rules") & set(HEAVY) == set()


def circles(edges: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Groups of names that import one another, directly or through others."""
    graph = nx.DiGraph((one, other) for one, other in edges if one != other)
    return [group for group in nx.strongly_connected_components(graph) if len(group) > 1]


def ours(*, on_load: bool = False) -> list[tuple[str, str]]:
    """Every import of a module of ours, anywhere or only when a module is loaded: importer, imported."""
    return [(name_of(path), name) for path in SOURCES for name in imports(path, on_load=on_load) if name in MODULES]


def of_benchmarks() -> list[tuple[str, str]]:
    """Every import between files of `benchmarks`, which name files of their folder without the folder."""
    files = sorted(path.relative_to(ROOT) for path in (ROOT / "benchmarks").rglob("*.py"))
    modules = {name_of(path) for path in files}
    pairs = [(path, name) for path in files for name in imports(path)]
    beside = [(name_of(path), ".".join([*path.parent.parts, name.partition(".")[0]])) for path, name in pairs]
    return [pair for pair in (*beside, *((name_of(path), name) for path, name in pairs)) if pair[1] in modules]


def folder_of(module: str) -> str:
    """Folder of a module; laws of heat and plain values, which use one another, are one."""
    if module in NOUNS:
        return "fleet"
    return module if module in PACKAGE_FILES else module.rpartition(".")[0]


PACKAGE_FILES = {name_of(path) for path in SOURCES if path.name == "__init__.py"}


def test_no_files_import_one_another():
    """Not even within a function."""
    assert circles(ours()) == []
    assert circles(of_benchmarks()) == []


def test_no_folders_load_one_another():
    assert circles((folder_of(one), folder_of(other)) for one, other in ours(on_load=True)) == []


def test_nobody_but_the_root_imports_an_adapter():
    adapters = [pair for pair in ours() if below(pair[1], "fleet.env.adapters")]
    assert [pair for pair in adapters if not below(pair[0], "fleet.env.adapters", "scenarios")] == []


def test_nothing_in_the_product_depends_on_a_benchmark():
    assert [name for path in SOURCES for name in imports(path) if below(name, "benchmarks", "tests", "docs")] == []


def test_no_file_is_longer_than_a_reader_takes_in():
    lines = {str(path): len((ROOT / path).read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert {path for path, count in lines.items() if count > LONGEST_FILE} == set()


def test_every_package_is_walked():
    assert {name.partition(".")[0] for name in MODULES} == set(PACKAGES)
    assert {"fleet.job", "fleet.heat.motor", "fleet.errors"} <= NOUNS
    assert len(SOURCES) > 40
