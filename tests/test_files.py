"""Atomic files, compiled code, counter-based random numbers, and inputs of every parser."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from fleet.errors import FleetError
from fleet.files import atomic_path, cache_folder, private_folder, user_cache_folder
from fleet.jit import compiled_sources
from fleet.seeding import LEVELS, child, exchange_seed, key_of, random_normal, random_uniform, random_word, shift_seeds


def test_a_file_is_replaced_when_the_block_ends(tmp_path):
    path = tmp_path / "plan.bin"
    path.write_bytes(b"old")
    with atomic_path(path) as draft:
        draft.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_of_a_link_the_target_is_replaced_and_a_special_file_is_refused(tmp_path):
    path, link, pipe = tmp_path / "plan.bin", tmp_path / "link", tmp_path / "pipe"
    link.symlink_to(path)
    with atomic_path(link) as draft:  # also one whose target does not exist yet
        draft.write_bytes(b"new")
    assert link.is_symlink()
    assert path.read_bytes() == b"new"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="no regular file"), atomic_path(pipe):
        pass
    assert set(tmp_path.iterdir()) == {path, link, pipe}


def test_after_an_error_the_file_is_unchanged_and_the_draft_is_gone(tmp_path):
    path = tmp_path / "plan.bin"
    path.write_bytes(b"old")

    def interrupted():
        with atomic_path(path) as draft:
            draft.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_cache_folders_follow_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("THERMOFLEET_CACHE", raising=False)
    assert cache_folder() == user_cache_folder() == tmp_path / "thermofleet"
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    assert user_cache_folder() == tmp_path / "thermofleet"


def test_a_cache_is_private_to_its_owner(tmp_path, monkeypatch):
    (tmp_path / "open").mkdir(mode=0o777)
    for name in ("new/deep", "open"):
        assert private_folder(tmp_path / name).stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    with pytest.raises(FleetError, match="belongs to another user, who could run code as you"):
        private_folder(tmp_path / "open")


ROOT = Path(__file__).parents[1]
DECORATORS = {"jit", "jit_inline", "kernel"}
MESSAGE = "Compiling functions (once: half a minute of one core for the simulation engine, some seconds for others)"
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


COUNTS = np.arange(600_000, dtype=np.uint64)


def key(seed: int) -> np.uint64:
    return np.uint64(key_of(np.random.SeedSequence(seed)))


def test_words_are_those_of_splitmix64() -> None:
    """Java's SplittableRandom and Vigna's splitmix64.c: outputs 1 to 5 for the seed 1234567."""
    expected = [
        6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821,
    ]  # fmt: skip
    assert random_word(np.uint64(1234567), np.arange(1, 6, dtype=np.uint64)).tolist() == expected


def test_uniform_values_are_uniform_and_independent() -> None:
    values = random_uniform(key(5), COUNTS)
    assert 0.0 <= values.min() <= values.max() < 1.0
    assert stats.kstest(values, "uniform").pvalue > 0.001
    assert np.abs(np.corrcoef(values.reshape(-1, 3).T) - np.eye(3)).max() < 0.01
    assert abs(np.corrcoef(values, random_uniform(key(6), COUNTS))[0, 1]) < 0.006


def test_normal_values_are_standard_normal_and_independent() -> None:
    values = random_normal(key(5), COUNTS)
    assert abs(values.mean()) < 4 / np.sqrt(len(values))
    assert values.var() == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(values)))
    assert stats.skew(values) == pytest.approx(0.0, abs=4 * np.sqrt(6 / len(values)))
    assert np.mean(np.abs(values) < 1.0) == pytest.approx(0.6827, abs=0.003)
    assert np.mean(np.abs(values) > 3.0) == pytest.approx(0.0027, abs=0.0004)
    assert np.abs(np.corrcoef(values.reshape(-1, 3).T) - np.eye(3)).max() < 0.01
    assert len(np.unique(values)) > 0.99 * LEVELS * (LEVELS + 1) / 2  # sums of two of the table's values


def test_a_value_depends_on_its_key_and_its_count_alone() -> None:
    every, other = random_normal(key(5), COUNTS), random_normal(key(6), COUNTS)
    assert random_normal(key(5), COUNTS[::-7]).tolist() == every[::-7].tolist()
    assert random_normal(key(5), COUNTS[[77, 0]]).tolist() == every[[77, 0]].tolist()
    assert np.mean(np.isclose(every, other)) < 0.001


def test_child_seeds_differ_and_leave_no_trace() -> None:
    seed = np.random.SeedSequence(9)
    jobs, sensors = shift_seeds(seed)
    keys = [key_of(each) for each in (seed, jobs, sensors, exchange_seed(sensors), child(seed, 0, 1))]
    assert len(set(keys)) == 5
    assert seed.n_children_spawned == 0
    assert key_of(exchange_seed(sensors)) == key_of(child(seed, 1, 0))
    assert [key_of(each) for each in shift_seeds(seed)] == [key_of(jobs), key_of(sensors)]


PARSE = """
import sys
from pathlib import Path
from benchmarks.fuzz.targets import TARGETS
for name in sys.argv[1:]:
    cases = Path("tests/fuzz_cases") / name
    for data in [*TARGETS[name].seeds(), *(path.read_bytes() for path in cases.glob("*"))]:
        TARGETS[name].parse(data)
"""


@pytest.mark.ci_slow
@pytest.mark.parametrize(
    "names", [("scenario", "message", "key", "jobs", "journal", "log", "settings"), ("checkpoint",)]
)
def test_every_parser_handles_its_cases(names):
    """In a process of its own, as the targets keep files in its folder."""
    done = subprocess.run(
        [sys.executable, "-c", PARSE, *names], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
