"""Run one unit of a study, in whichever process it is."""

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from dataclasses import asdict, dataclass, field
from pathlib import Path
from traceback import format_tb

from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError
from fleet.files import cache_folder
from scenarios.policy_loader import error_text
from scenarios.prepare.fleet import RiskName
from scenarios.prepare.randomisation import Randomisation
from scenarios.run import evaluate
from scenarios.run.evaluate import Outcome, Played, play
from scenarios.run.provenance import code_hash
from scenarios.trials.fleets import Fleets
from scenarios.trials.plan import Row, Study, Unit, policy_hash

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


def run_unit(unit: Unit, settings: Settings) -> list[Row]:
    """The rows of a unit; what a policy raises is in them.

    Raises:
        FleetError: the fleet cannot be prepared, or this machine has other code or another policy.
    """
    _check(unit.policy, settings)
    fleet = fleets.of(unit, settings.risk, settings.folder or cache_folder(), randomise=settings.randomise)
    with _one_thread(), _contained():  # one thread, so that sums have one order
        played = play(fleet, unit.played, unit.case.seeds, settings.channel, settings.decision_limit_s)
    _check(unit.policy, settings)  # its files may have been changed meanwhile
    return [row_of(unit, i, each) for i, each in enumerate(played)]


def row_of(unit: Unit, index: int, played: Played) -> Row:
    """The row of the unit's i-th shift."""
    key = unit.keys[index]
    if played.outcome is not None:
        figures = {name: float(value) for name, value in asdict(played.outcome).items()}  # as a file gives them
        return Row(key, Outcome(**figures), played.illegal)
    assert played.error is not None
    error = error_text(played.error)[:MOST_TEXT]
    frames = [text for text in format_tb(played.error.__traceback__) if f'"{evaluate.__file__}"' not in text]
    trace = "".join(frames[-MOST_TRACE:])
    return Row(key, None, 0, f"{error} (at {played.time_s:g} s of the shift)", trace[-MOST_TEXT:])


def died(unit: Unit) -> list[Row]:
    """The rows of a unit whose processes died again and again."""
    error = f"The process that ran it died {unit.deaths} times."
    return [Row(key, None, 0, error, "") for key in unit.keys]


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
