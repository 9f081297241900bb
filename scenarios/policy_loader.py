"""Policies by name: one of `agents.registry`, a user-defined one as `FILE.py:OBJECT` or `MODULE:OBJECT`, one in another
process as `bus:NAME` or `bus:NAME@ENDPOINT`, the folder of a trained one, or any of these in a wrapper, as
`WRAPPER:POLICY`. An object is a class or a function that returns a new policy."""

import importlib
import importlib.util
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from inspect import signature
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any

import numpy as np

from agents.heat import guarded
from agents.pairs import PAIRS, load_pairs
from agents.policy import SCOPES, ArmPolicy, PlanningPolicy, Policy, for_all_arms, no_simulator
from agents.registry import RULES, WRAPPERS, rule_of
from fleet.errors import NAME_RULE, FleetError, is_name, nearest, printable
from fleet.seeding import child
from scenarios.spec.options import ENDPOINT

MOST_WRAPPERS = 8
"""Wrappers in one another; more than a policy can need."""
METHODS = {
    "central": {"reset": "rng", "act": "observations"},
    "arm": {"reset": "rng", "choose": "observation, arm_index"},
}
"""Methods, and their arguments, that a policy of each scope must have."""
OWN_PACKAGES = ("fleet", "agents", "twin", "scenarios", "thermofleet")
"""Of this project: no module beside a policy takes their place, and the hash of the code covers them."""
BUS = "bus:"
"""Before the name of a policy in another process."""


@dataclass(frozen=True, kw_only=True)
class OnBus:
    """How a policy in another process is queried."""

    fleet: str = "simulation"
    """Name of the fleet in its key."""
    endpoint: str = ENDPOINT
    """Of the router, unless the name of the policy has one."""
    limit_s: float = 60.0
    """Most real seconds for a decision."""


ON_BUS = OnBus()


class PolicyFailed(FleetError):
    """A user-defined policy raised an exception or returned no action."""


def failure(name: str, error: BaseException, where: str) -> BaseException:
    """What to raise for an error of a policy: a sentence, or the error itself of a built-in policy or a `FleetError`.

    Args:
        where: In which shift, as `quickstart/3`.
    """
    if isinstance(error, FleetError) or is_built_in(name):
        return error
    source = source_of(name)
    line = last_line(error, source) if source else None
    place = f" ({source.absolute()}, line {line})" if source and line else ""
    return PolicyFailed(f"The policy '{name}' failed in {where}: {error_text(error).rstrip('.: ')}{place}.")


def is_ctrl_c(error: BaseException) -> bool:
    """Whether an error may be Ctrl-C; a worker ignores that, so a `KeyboardInterrupt` in it is raised by code."""
    return isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) != signal.SIG_IGN


@contextmanager
def blaming(name: str, where: str) -> Iterator[None]:
    """Raise the `failure` of a policy for every exception of its code in the block, SystemExit too."""
    try:
        yield
    except BaseException as error:
        if is_ctrl_c(error):
            raise
        raise failure(name, error, where) from error


def last_line(error: BaseException, file: Path) -> int | None:
    """The line of a file in which an error was raised, or from which the code that raised it was called."""
    lines = [
        frame.lineno for frame in extract_tb(error.__traceback__) if Path(frame.filename).absolute() == file.absolute()
    ]
    return lines[-1] if lines else None


def error_text(error: BaseException) -> str:
    """Kind and text of an error of a policy, also of one without a text."""
    try:
        text = str(error).encode("utf-8", "backslashreplace").decode()
    except Exception as failed:  # of its code
        text = f"(its text raises {type(failed).__name__})"
    return f"{type(error).__name__}{f': {text}' if text else ''}"


def policy_of(name: str, bus: OnBus = ON_BUS) -> Policy:
    """A fresh policy for all arms.

    Raises:
        FleetError: no such rule, file, module, class or folder, one that is not a policy, or a class that needs
            arguments.
    """
    return for_all_arms(_maker(name, bus))


def arm_policy_of(name: str) -> ArmPolicy:
    """A fresh policy of scope `arm`, for one arm.

    Raises:
        FleetError: as `policy_of`, or the policy is a central one.
    """
    if scope_of(name) != "arm":
        raise FleetError(f"'{name}' is a central policy: it needs the observations of all arms, not of one.")
    return _maker(name, ON_BUS)()  # pyright: ignore[reportReturnType]  # by its scope


def check_name(policy: object) -> None:
    """Check that a policy is given by its name.

    Raises:
        FleetError: it is a class or an object.
    """
    if not isinstance(policy, str):
        raise FleetError(
            f"A policy is given by name: 'wspt', or 'mine.py:Mine' for a class in a file (got {policy!r})."
        )


def scope_of(name: str) -> str:
    """The scope of a policy; no trained one is loaded for it.

    Raises:
        FleetError: as `policy_of`.
    """
    _, name = _unwrapped(name)
    if is_on_bus(name):
        return "central"
    if has_trainings(name):
        return scope_of(trainings_of(name)[0])
    if _is_folder(name):
        return "central" if _has_pairs(name) else "arm"
    return _made_by(name)[1]


def policy_at(name: str, seed: int, bus: OnBus = ON_BUS) -> Policy:
    """A fresh policy at the beginning of the shift of a seed, with its random generator.

    Raises:
        FleetError: as `policy_of`.
    """
    policy = policy_of(name, bus)
    policy.reset(np.random.default_rng(child(np.random.SeedSequence([seed, 1]), 0)))
    return policy


def without_simulator(name: str, policy: Policy) -> Policy:
    """The policy of a name, where there is no simulator of the cell.

    Raises:
        FleetError: it plans in a simulator.
    """
    if isinstance(policy, PlanningPolicy):
        raise no_simulator(name)
    return policy


def plans(name: str) -> bool:
    """Whether a policy plans in a simulator of its cell, as its class says; none is made for it.

    Raises:
        FleetError: as `policy_of`.
    """
    _, name = _unwrapped(name)
    return not (is_on_bus(name) or has_trainings(name) or _is_folder(name)) and hasattr(_made_by(name)[0], "plan_in")


def is_built_in(name: str) -> bool:
    """Whether a name is that of a rule, perhaps in wrappers; no code is loaded for it."""
    return _unwrapped(name)[1] in RULES


def is_on_bus(name: str) -> bool:
    """Whether a policy runs in another process, perhaps in wrappers."""
    return _unwrapped(name)[1].startswith(BUS)


def source_of(name: str) -> Path | None:
    """The file or folder of a user-defined policy; None for a rule, and for one in another process.

    Raises:
        FleetError: there is no such module.
    """
    _, name = _unwrapped(name)
    if is_on_bus(name):
        return None
    if _is_folder(name):
        return Path(name)
    where = name.rpartition(":")[0]
    if not where or where.endswith(".py"):
        return Path(where) if where else None
    file = getattr(_module(where, name), "__file__", None)
    return Path(file) if file else None


def trainings_of(name: str) -> tuple[str, ...]:
    """The policies that a pattern stands for: trainings of one recipe, in folders; of another name itself.

    Raises:
        FleetError: no folder has such a name.
    """
    if not has_trainings(name):
        return (name,)
    wrappers, pattern = _unwrapped(name)
    path = Path(pattern)
    folders = [str(each) for each in path.parent.glob(path.name) if each.is_dir()]
    if not folders:
        raise FleetError(f"There is no folder '{pattern}': it must match the folders of `thermofleet train --seeds K`.")
    return tuple(":".join((*wrappers, each)) for each in sorted(folders, key=lambda each: (len(each), each)))  # 2 < 10


def has_trainings(name: str) -> bool:
    """Whether a name is a pattern of folders, with * or ?, and stands for several trainings."""
    return ("*" in name or "?" in name) and not is_on_bus(name)


def label(name: str) -> str:
    """What a table calls a policy: the rule, the class, or the last folder, after its wrappers."""
    wrappers, name = _unwrapped(name)
    if is_on_bus(name):
        name = name.partition("@")[0]
    elif _is_folder(name) or has_trainings(name):
        name = Path(os.path.abspath(name)).name
    else:
        name = name.rpartition(":")[2]
    return ":".join((*wrappers, name))


def _unwrapped(name: str) -> tuple[list[str], str]:
    """The wrappers of a name, the outermost first, and the name of the policy in them."""
    wrappers: list[str] = []
    first, colon, rest = name.partition(":")
    while colon and first in WRAPPERS:
        wrappers.append(first)
        name = rest
        first, colon, rest = name.partition(":")
    return wrappers, name


def _is_folder(name: str) -> bool:
    return bool(name) and Path(name).is_dir()


def _has_pairs(name: str) -> bool:
    return (Path(name) / PAIRS).is_file()


def _maker(name: str, bus: OnBus) -> Callable[[], Policy] | Callable[[], ArmPolicy]:
    wrappers, inner = _unwrapped(name)
    if len(wrappers) > MOST_WRAPPERS:
        raise FleetError(f"A policy has at most {MOST_WRAPPERS} wrappers round it ({', '.join(WRAPPERS)}).")
    make: Callable[[], Any] = _maker_of(inner, bus)
    for wrapper in reversed(wrappers):
        make = partial(lambda kind, make: guarded(kind, make()), WRAPPERS[wrapper].kind, make)
    return make


def _maker_of(name: str, bus: OnBus) -> Callable[[], Policy] | Callable[[], ArmPolicy]:
    if _is_folder(name) and _has_pairs(name):
        return partial(load_pairs, Path(name))
    if _is_folder(name):
        from agents.learned.policy import load_policy

        return partial(load_policy, Path(name))
    if not is_on_bus(name):
        return _made_by(name)[0]
    policy, at, endpoint = name.removeprefix(BUS).partition("@")
    if not is_name(policy):
        raise FleetError(f"After '{BUS}' the name of a policy must have {NAME_RULE}, no @ (got '{printable(policy)}').")
    from fleet.live.policy_client import PolicyClient  # loads zenoh

    return partial(
        PolicyClient, policy, fleet=bus.fleet, endpoint=endpoint if at else bus.endpoint, limit_s=bus.limit_s
    )


def _made_by(name: str) -> tuple[Callable[[], Policy] | Callable[[], ArmPolicy], str]:
    """What makes the policy of a name that is no folder, and its scope."""
    if ":" not in name and not name.endswith(".py"):
        try:
            return rule_of(name).kind, rule_of(name).scope
        except ValueError as error:
            raise FleetError(f"{error} Or name your own as FILE.py:CLASS, or the folder of a trained one.") from error
    where, _, kind = name.rpartition(":") if ":" in name else (name, "", "")
    module = _module(where, name)
    found = getattr(module, kind, None)
    if not callable(found):
        own = [key for key, each in vars(module).items() if getattr(each, "__module__", "") == module.__name__]
        problem = f"No class '{kind}' in '{where}'" if kind else f"'{where}' names no class: give {where}:CLASS"
        raise FleetError(f"{problem}{nearest(kind, own)}")
    try:
        signature(found).bind()
    except TypeError as error:
        raise FleetError(
            f"'{name}' must be a class or function that is called without arguments ({error}): give its parameters "
            "defaults."
        ) from error
    example = found if isinstance(found, type) else found()
    scope = getattr(example, "scope", None)
    if scope not in SCOPES:
        raise FleetError(
            f"The policy '{name}' has no valid scope (got {scope!r}). Set in the class: scope = \"central\" if its "
            'act(observations) sees all arms, or scope = "arm" if its choose(observation, arm_index) sees one.'
        )
    missing = [method for method in METHODS[scope] if not callable(getattr(example, method, None))]
    if missing:
        needed = " and ".join(f"{method}({arguments})" for method, arguments in METHODS[scope].items())
        raise FleetError(f"'{name}' is no policy: of scope {scope} it needs the methods {needed}.")
    return found, scope  # pyright: ignore[reportReturnType]  # by its scope and methods


def _module(where: str, name: str) -> ModuleType:
    if not where.endswith(".py"):
        try:
            return importlib.import_module(where)
        except ImportError as error:
            known = f"Rules: {', '.join(RULES)}. Wrappers: {', '.join(WRAPPERS)}."
            raise FleetError(f"Policy '{name}': cannot import '{where}' ({error}). {known}") from error
        except (Exception, SystemExit) as error:  # of the module
            raise _not_loaded(name, where, error, None) from error
    path = Path(where)
    spec = importlib.util.spec_from_file_location(f"own_policy_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FleetError(f"Policy '{name}': there is no file '{where}'.")
    module = importlib.util.module_from_spec(spec)
    try:
        with _importing_beside(path, module):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # of the file
        raise _not_loaded(name, where, error, last_line(error, path)) from error
    return module


@dataclass(frozen=True)
class _Beside(MetaPathFinder):
    """Imports the modules and packages in the folder of a policy, but none that the standard library or this project
    has, nor from the folder of installed packages."""

    folder: Path
    names: frozenset[str]

    @classmethod
    def of(cls, file: Path) -> "_Beside":
        folder = file.absolute().parent
        packages = {each.parent.name for each in folder.glob("*/__init__.py")}
        names = packages.union(each.stem for each in folder.glob("*.py")) - {*OWN_PACKAGES, *sys.stdlib_module_names}
        return cls(folder, frozenset(() if "site-packages" in folder.parts else names))

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        return PathFinder.find_spec(fullname, [str(self.folder)]) if path is None and fullname in self.names else None

    def take(self) -> dict[str, ModuleType]:
        """Remove what has these names, and modules in it, from `sys.modules`."""
        taken = [name for name in sys.modules if name.partition(".")[0] in self.names]
        return {name: sys.modules.pop(name) for name in taken}


_BESIDE: dict[Path, dict[str, tuple[ModuleType, int]]] = {}
"""Modules that files of a folder have imported from it, by folder and name, each with the time of its file's change."""


@contextmanager
def _importing_beside(file: Path, module: ModuleType) -> Iterator[None]:
    """Let a file import modules of its folder in the block, as a script does; all anew if one of them has changed.

    Afterwards they leave `sys.modules`: files of two folders never share a module of one name.
    """
    beside = _Beside.of(file)
    others = beside.take()
    kept = _BESIDE.get(beside.folder, {})
    if all(_changed_ns(each) == changed_ns for each, changed_ns in kept.values()):
        sys.modules.update({name: each for name, (each, _) in kept.items()})
    sys.modules[module.__name__] = module  # where dataclasses look up annotations
    sys.meta_path.insert(0, beside)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.meta_path.remove(beside)
        _BESIDE[beside.folder] = {name: (each, _changed_ns(each)) for name, each in beside.take().items()}
        sys.modules.pop(module.__name__, None)
        sys.modules.update(others)


def _changed_ns(module: ModuleType) -> int:
    file = Path(getattr(module, "__file__", None) or "")
    return file.stat().st_mtime_ns if file.is_file() else 0


def _not_loaded(name: str, where: str, error: BaseException, line: int | None) -> FleetError:
    syntax = isinstance(error, SyntaxError)
    line, text = (error.lineno, error.msg) if syntax else (line, error_text(error).partition(": ")[2])
    kind = f"{type(error).__name__}{f' in line {line}' if line else ''}"
    return FleetError(f"Policy '{name}': '{where}' cannot be loaded: {kind}{f': {text}' if text else ''}.")
