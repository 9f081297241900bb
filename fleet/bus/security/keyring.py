"""The folder of keys of one fleet: create it, add to it, read it.

ca.pem ca.key        the certificate authority; its private key is needed only to issue certificates
roster.json          the participants and their roles, from which the router derives its access control
NAME.pem NAME.key    certificate and private key of each participant
"""

import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import msgspec

from fleet.bus.security.access_control import ROSTER, Participant, Roster, read_roster
from fleet.bus.security.certificates import CA, HERE, issue, new_authority, read, written_atomically
from fleet.errors import BusError

_OWN_FILES = re.compile(rf"(.+\.(pem|key)|\.?{re.escape(ROSTER)})(\.\d+\.\d+)?")
"""Names of files in a folder of keys; those with numbers were left by a process that was killed while it wrote."""


def make(
    folder: Path, roster: Roster, *, days: int, hosts: Sequence[str] = HERE, overwrite: bool = False
) -> dict[str, datetime]:
    """Create an authority and a certificate for every participant; an error leaves the folder as it was.

    Returns:
        When each certificate expires, by name.

    Raises:
        BusError: the folder is not empty, or cannot be written.
    """
    place = Path(os.path.abspath(folder))
    _check_free(folder, overwrite)
    work: Path | None = None
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))  # 0700
        new_authority(work, roster.fleet)
        expires = {one.name: issue(work, one, days=days, hosts=hosts) for one in roster.participants}
        _write_roster(work, roster)
        _replace(work, place)
    except OSError as error:
        raise BusError(f"'{folder}' could not be written: {error.strerror}.") from error
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    return expires


def add(
    folder: Path, participant: Participant, *, days: int, hosts: Sequence[str] = HERE, overwrite: bool = False
) -> datetime:
    """Issue a certificate by the present authority, to a new participant or, with `overwrite`, to a present one.

    Returns:
        When it expires.

    Raises:
        BusError: the name is taken, or the folder cannot sign.
    """
    roster = read_roster(folder)
    present = [one for one in roster.participants if one.name == participant.name]
    if present and not overwrite:
        raise BusError(f"'{participant.name}' has a certificate in '{folder}'; --overwrite gives it a new one.")
    if present and present != [participant]:
        raise BusError(f"'{participant.name}' has the role {present[0].role} in '{folder}', not {participant.role}.")
    if not present:
        try:
            roster = Roster(roster.fleet, (*roster.participants, participant))
        except ValueError as error:
            raise BusError(str(error)) from error
    expires = issue(folder, participant, days=days, hosts=hosts)
    _write_roster(folder, roster)
    return expires


def lifetimes(folder: Path, roster: Roster) -> dict[str, tuple[datetime, datetime]]:
    """When each certificate of a folder begins and expires, by name, the authority's included.

    Raises:
        BusError: one is missing or damaged.
    """
    files = {CA: CA, **{one.name: one.file for one in roster.participants}}
    certificates = {name: read(folder, file) for name, file in files.items()}
    return {name: (one.not_valid_before_utc, one.not_valid_after_utc) for name, one in certificates.items()}


def _write_roster(folder: Path, roster: Roster) -> None:
    with written_atomically(folder / ROSTER, msgspec.json.format(msgspec.json.encode(roster), indent=1) + b"\n"):
        pass


def _check_free(folder: Path, overwrite: bool) -> None:
    """Refuse a folder that holds anything but keys, or keys that `overwrite` does not allow to replace."""
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise BusError(f"'{folder}' exists and is not a folder.")
    names = sorted(path.name for path in folder.iterdir())
    if not names:
        return
    foreign = [name for name in names if not _OWN_FILES.fullmatch(name)]
    if ROSTER not in names or foreign:
        raise BusError(f"'{folder}' is not a folder of keys: it holds '{(foreign or names)[0]}'. Choose another one.")
    if not overwrite:
        raise BusError(
            f"'{folder}' holds the keys of a fleet. --add issues one more certificate; --overwrite makes a new "
            "certificate authority, and every participant then needs a new certificate."
        )


def _replace(work: Path, place: Path) -> None:
    """Rename `work` to `place`; after an error the previous folder is still there."""
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
