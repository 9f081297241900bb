"""The folder of keys of one fleet: made whole, added to, and read.

ca.pem ca.key        the certificate authority; its key is needed to add participants, and by nobody else
roster.json          who takes part: what the router makes its rules from
NAME.pem NAME.key    certificate and private key of each participant
"""

import os
import shutil
import tempfile
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import msgspec

from fleet.bus.security.access_control import ROSTER, Participant, Roster, read_roster
from fleet.bus.security.certificates import CA, HERE, issue, new_authority, read, write_whole
from fleet.errors import BusError


def make(
    folder: Path, roster: Roster, *, days: int, hosts: Sequence[str] = HERE, overwrite: bool = False
) -> dict[str, datetime]:
    """Make a new authority and a certificate for everybody in the roster; the folder appears whole, or not at all.

    Returns:
        When each certificate ends, by name.

    Raises:
        BusError: the folder holds something already, or cannot be written.
    """
    place = Path(os.path.abspath(folder))
    _check_free(folder, overwrite)
    work: Path | None = None
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))  # 0700
        new_authority(work, roster.fleet)
        ends = {one.name: issue(work, one, days=days, hosts=hosts) for one in roster.participants}
        _write_roster(work, roster)
        _swap(work, place)
    except OSError as error:
        raise BusError(f"'{folder}' could not be written: {error.strerror}.") from error
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    return ends


def add(
    folder: Path, participant: Participant, *, days: int, hosts: Sequence[str] = HERE, overwrite: bool = False
) -> datetime:
    """Issue one more certificate by the authority that is there, or a new one to a participant that has one.

    Returns:
        When it ends.

    Raises:
        BusError: the name is taken, or the folder cannot sign.
    """
    roster = read_roster(folder)
    there = [one for one in roster.participants if one.name == participant.name]
    if there and not overwrite:
        raise BusError(f"'{participant.name}' has a certificate in '{folder}'; --overwrite gives it a new one.")
    if there and there != [participant]:
        raise BusError(f"'{participant.name}' is of the role {there[0].role} in '{folder}', not {participant.role}.")
    try:
        fuller = roster if there else Roster(roster.fleet, (*roster.participants, participant))
    except ValueError as error:
        raise BusError(str(error)) from error
    ends = issue(folder, participant, days=days, hosts=hosts)
    _write_roster(folder, fuller)
    return ends


def spans_of(folder: Path, roster: Roster) -> dict[str, tuple[datetime, datetime]]:
    """When each certificate of a folder begins and ends, by name, the authority among them.

    Raises:
        BusError: one is missing or damaged.
    """
    files = {CA: CA, **{one.name: one.file for one in roster.participants}}
    read_all = {name: read(folder, file) for name, file in files.items()}
    return {name: (one.not_valid_before_utc, one.not_valid_after_utc) for name, one in read_all.items()}


def _write_roster(folder: Path, roster: Roster) -> None:
    write_whole(folder / ROSTER, msgspec.json.format(msgspec.json.encode(roster), indent=1) + b"\n")


def _check_free(folder: Path, overwrite: bool) -> None:
    """Refuse to replace what is no folder of keys, or is one and nobody said so."""
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise BusError(f"'{folder}' is there already, and is no folder.")
    holds = sorted(path.name for path in folder.iterdir())
    if not holds:
        return
    strange = [name for name in holds if name != ROSTER and not name.endswith((".pem", ".key", ".tmp"))]
    if ROSTER not in holds or strange:
        raise BusError(f"'{folder}' holds something else ({(strange or holds)[0]}); choose another folder.")
    if not overwrite:
        raise BusError(
            f"'{folder}' holds the keys of a fleet. --add issues one more certificate; --overwrite makes a new "
            "certificate authority, and everybody then needs a new certificate."
        )


def _swap(work: Path, place: Path) -> None:
    """Let `work` take the place of what was there, which stays if that fails."""
    if not place.exists():
        work.rename(place)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{place.name}.old.", dir=place.parent))
    old = aside / place.name
    try:
        place.rename(old)
        work.rename(place)
    except OSError:
        if old.exists():
            old.rename(place)
        aside.rmdir()
        raise
    shutil.rmtree(aside, ignore_errors=True)
