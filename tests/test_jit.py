"""Messages about compiling, and the files on which compiled code depends."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from fleet.jit import compiled_sources

ROOT = Path(__file__).parents[1]
DECORATORS = {"jit", "jit_inline", "kernel"}
MESSAGE = "Compiling the simulation engine"
DRAW = """
import numpy as np
from fleet.env.random_actions import random_legal
print(random_legal(np.eye(3, dtype=np.int8), np.random.default_rng(0)))
"""


def start(home: Path, **variables: str) -> str:
    """Messages of a process that runs one kernel."""
    env = os.environ | {"XDG_CACHE_HOME": str(home)} | variables
    process = subprocess.run(
        [sys.executable, "-c", DRAW], env=env, capture_output=True, text=True, timeout=300, check=True
    )
    assert process.stdout == "[0 1 2]\n"
    return process.stderr


def test_only_the_first_process_compiles(tmp_path):
    first = start(tmp_path)
    assert first.count(MESSAGE) == 1
    assert str(tmp_path) in first
    assert start(tmp_path) == ""


def test_nothing_is_compiled_where_that_is_switched_off(tmp_path):
    assert start(tmp_path, NUMBA_DISABLE_JIT="1") == ""


@cache
def definitions(path: Path) -> tuple[dict[str, ast.AST], dict[str, tuple[Path, str]]]:
    """Functions and constants of a file, by name; and the names that it imports from files of `fleet`."""
    own: dict[str, ast.AST] = {}
    imported: dict[str, tuple[Path, str]] = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            own[node.name] = node
        elif isinstance(node, ast.Assign):
            targets = [name for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)]
            own |= {name.id: node.value for name in targets}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            own[node.target.id] = node.value
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("fleet."):
            source = (ROOT / str(node.module).replace(".", "/")).with_suffix(".py")
            imported |= {alias.asname or alias.name: (source, alias.name) for alias in node.names}
    return own, imported


def used(path: Path, name: str, seen: set[tuple[Path, str]]) -> Iterator[Path]:
    """The files on which a function or constant of a file depends, itself included."""
    if (path, name) in seen or not path.is_file():
        return
    seen.add((path, name))
    own, imported = definitions(path)
    if name in imported:
        yield from used(*imported[name], seen)
    elif name in own:
        yield path
        node = own[name]
        for part in node.body if isinstance(node, ast.FunctionDef) else [node]:
            for each in ast.walk(part):
                if isinstance(each, ast.Name):
                    yield from used(path, each.id, seen)


def test_compiled_code_is_renewed_when_any_file_that_it_depends_on_changes():
    needed: set[Path] = set()
    for path in (ROOT / "fleet").rglob("*.py"):
        for name, node in definitions(path)[0].items():
            if isinstance(node, ast.FunctionDef) and DECORATORS & {ast.unparse(one) for one in node.decorator_list}:
                files = set(used(path, name, set()))
                needed |= files if files != {path} else set()  # numba itself looks at the file of the function
    assert len(needed) > 10
    assert needed - set(compiled_sources()) == set()
