"""Run a study: here in the first seconds, then on many processes, with its rows in memory or in a folder."""

import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from traceback import format_tb

from joblib import cpu_count

from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError
from fleet.files import cache_folder
from scenarios.evaluate import rollout
from scenarios.evaluate.rollout import Outcome, ShiftResult, play
from scenarios.evaluate.sources import Fleets, is_trained, plan_content
from scenarios.evaluate.store import Store, opened
from scenarios.evaluate.study import Row, RowKey, Study, Unit, policy_hash
from scenarios.extras import require_extra
from scenarios.policy_loader import error_text, is_built_in
from scenarios.prepare.fleet import Fleet
from scenarios.prepare.randomisation import Randomisation
from scenarios.processes import MOST_DEATHS, LocalWorker, Queue, Worker, WorkUnit, run_all
from scenarios.progress import Count, Progress, quiet
from scenarios.run.log import code_hash
from scenarios.spec.options import RiskName

HERE_S = 5.0
"""About the time that a worker process takes to start. This process does work that takes no longer, but runs no code of
users, which might end it."""


MOST_TRACE = 4
"""Frames of a traceback that are kept, the last ones."""
MOST_TEXT = 2000
"""Characters of a message that are kept."""


@dataclass(frozen=True)
class Settings:
    """What all units of a study share."""

    risk: RiskName
    randomise: Randomisation | None
    channel: Channel
    decision_limit_s: float | None
    folder: Path | None
    """Cache of plans and twins; None for that of the process."""
    code_hash: str
    policies: dict[str, str] = field(hash=False)
    """Hashes of the policies' files."""

    @classmethod
    def of(cls, study: Study, folder: Path | None) -> "Settings":
        """The settings of a study that this process starts."""
        return cls(
            study.risk, study.randomise, study.channel, study.decision_limit_s, folder, code_hash(), study.policy_hashes
        )


fleets = Fleets()
"""Of this process."""


def _fleet_of(unit: Unit, settings: Settings, progress: Progress = quiet) -> Fleet:
    return fleets.of(
        unit.scenario, unit.difficulty, settings.risk, settings.folder or cache_folder(), progress,
        training=unit.twins, randomise=settings.randomise,
    )  # fmt: skip


def run_unit(unit: Unit, settings: Settings) -> list[Row]:
    """The rows of a unit; what a policy raises is in them.

    Raises:
        FleetError: the fleet cannot be prepared, or this machine has other code or another policy.
    """
    _check(unit.policy, settings)
    fleet = _fleet_of(unit, settings)
    with _one_thread(), _contained():  # one thread, so that sums have one order
        played = play(fleet, unit.played, unit.case.seeds, settings.channel, settings.decision_limit_s)
    _check(unit.policy, settings)  # its files may have been changed meanwhile
    return [_row_of(key, each) for key, each in zip(unit.keys, played, strict=True)]


def _row_of(key: RowKey, played: ShiftResult) -> Row:
    if played.outcome is not None:
        figures = {name: float(value) for name, value in asdict(played.outcome).items()}  # as a file gives them
        return Row(key, Outcome(**figures), played.illegal)
    assert played.error is not None
    error = error_text(played.error)[:MOST_TEXT]
    frames = [text for text in format_tb(played.error.__traceback__) if f'"{rollout.__file__}"' not in text]
    trace = "".join(frames[-MOST_TRACE:])
    return Row(key, None, 0, f"{error} (at {played.time_s:g} s of the shift)", trace[-MOST_TEXT:])


@dataclass(frozen=True)
class UnitWork(WorkUnit[list[Row]]):
    """A unit as a piece of work for a process."""

    unit: Unit
    settings: Settings

    @property
    def name(self) -> str:
        return f"'{self.unit.policy}' on {self.unit.case.name}, seed {self.unit.case.seeds[0]}"

    @property
    def group(self) -> object:
        return self.unit.group

    def __call__(self) -> list[Row]:
        return run_unit(self.unit, self.settings)

    def after_death(self) -> "list[UnitWork]":
        """Each shift alone, because the process may have died of one shift only."""
        case = self.unit.case
        parts = [replace(self.unit, case=replace(case, seeds=(seed,))) for seed in case.seeds]
        return [UnitWork(part, self.settings, deaths=self.deaths + 1) for part in parts]

    def given_up(self) -> list[Row]:
        """Rows of failed shifts."""
        error = f"The process that ran it died {MOST_DEATHS} times."
        return [Row(key, None, 0, error, "") for key in self.unit.keys]


def _check(policy: str, settings: Settings) -> None:
    here = f"process {os.getpid()} on {socket.gethostname()}"
    if code_hash() != settings.code_hash:
        raise FleetError(
            f"The {here} runs other code of thermofleet than this command began with: install the same on every "
            "machine, and change no code while it runs."
        )
    try:
        found = policy_hash(policy)
    except OSError as error:
        raise FleetError(f"The {here} cannot read the policy '{policy}': {error.strerror}.") from error
    if found != settings.policies[policy]:
        raise FleetError(
            f"The {here} has other files of the policy '{policy}' than this command began with: copy the same to every "
            "machine, and change none while it runs."
        )


@contextmanager
def _contained() -> Iterator[None]:
    """Keep what a policy prints off standard output, and undo what it does to the process; end a fork of it."""
    process, folder, streams = os.getpid(), Path.cwd(), (sys.stdout, sys.stderr)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        if os.getpid() != process:
            os._exit(0)
        sys.stdout, sys.stderr = streams
        os.chdir(folder)


def _one_thread() -> AbstractContextManager[None]:
    if "torch" not in sys.modules:
        return nullcontext()
    from twin.vae.model import one_thread

    return one_thread()


def run_study(
    study: Study,
    *,
    out: Path | None = None,
    cache_dir: Path | None = None,
    workers: int = -1,
    ray: str | None = None,
    progress: Progress = quiet,
    tell: Callable[[str], None] = lambda sentence: None,
) -> list[Row]:
    """The rows of a study, in the order of its keys.

    Args:
        out: Folder of the rows; those that are in it are not run again, unless they failed.
        workers: Processes, if there is work for more than some seconds; -1 for one per core. The rows do not depend
            on it.
        ray: Address of a Ray cluster to run on instead.
        tell: Called with a sentence about what is run again, and about each process that dies.

    Raises:
        FleetError: a fleet cannot be prepared, the folder holds something else, or the cluster cannot be reached.
        MissingExtra: a library is not installed.
    """
    wanted = [key for unit in study.units(()) for key in unit.keys]
    if out is not None:
        require_extra("report")
    with nullcontext(Store()) if out is None else opened(out, study.card) as store:
        # The largest first, so that processes end together; what shares plans follows.
        done = {key for key, row in store.rows.items() if row.error is None}
        if failed := sum(key in store.rows and key not in done for key in wanted):
            tell(f"Running again what failed before: {failed} shift{'s' * (failed > 1)}.")
        units = sorted(study.units(done), key=lambda unit: (-unit.size, unit.cell))
        # The folder is stated here, because a worker may have started with another one; other machines have their own.
        settings = Settings.of(study, cache_dir if ray else cache_dir or cache_folder())
        if ray is None or any(map(is_trained, study.sources)):
            _prepare_once(units, settings, progress)
        count = len(wanted) - sum(len(unit.case.seeds) for unit in units)
        progress("comparing", Count(count, len(wanted)))
        for rows in _run(units, settings, workers, ray, tell):
            store.add(rows)
            count += len(rows)
            progress("comparing", Count(count, len(wanted)))
        return [store.rows[key] for key in wanted]


def _prepare_once(units: list[Unit], settings: Settings, progress: Progress) -> None:
    """Make the plans and twins that units share, so that no two processes make the same; all land in the cache."""
    seen: set[object] = set()
    for unit in units:
        cell = (plan_content(unit.scenario), unit.twins, unit.difficulty)
        if cell not in seen:
            seen.add(cell)
            _fleet_of(unit, settings, progress)


def _run(
    units: list[Unit], settings: Settings, workers: int, ray: str | None, tell: Callable[[str], None]
) -> Iterator[list[Row]]:
    began_s, todo, left_s = time.monotonic(), list(units), 0.0
    whole = left = sum(unit.size for unit in units)
    while todo and not ray and is_built_in(todo[0].played) and (workers == 1 or left_s < HERE_S):
        unit = todo.pop(0)
        yield run_unit(unit, settings)
        left -= unit.size
        left_s = (time.monotonic() - began_s) * left / (whole - left)
    if todo:
        queue = Queue(UnitWork(unit, settings) for unit in todo)
        several = _workers(workers, ray, len(todo))
        try:
            for _, rows in run_all(queue, several, tell):
                yield rows
        finally:
            for each in several:
                each.close()  # a policy may have left something in it


def _workers(count: int, ray: str | None, most: int) -> list[Worker]:
    if ray is None:
        return [LocalWorker() for _ in range(min(count if count > 0 else cpu_count(), most))]
    require_extra("ray")
    from scenarios.evaluate.ray_workers import ray_workers

    return list(ray_workers(ray))
