"""Folders of results, written atomically: a reader finds either the complete folder or none."""

import fcntl
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import msgspec

from fleet.errors import FleetError
from fleet.files import atomic_path, replace_folder


@dataclass(frozen=True, kw_only=True)
class ResultKind:
    """How to recognise an earlier result, so that a command replaces only a result of the same kind."""

    name: str
    """For error messages, as in "a finished run"."""
    card: str
    """A JSON file with a field `status`: finished or interrupted."""
    files: tuple[str, ...]
    """Patterns of every file the folder may hold."""


def folder_at(name: str, path: object) -> Path:
    """The folder whose path is given as an argument of a function.

    Raises:
        FleetError: it is no path; names the argument.
    """
    if not isinstance(path, str | Path) or path == "":
        raise FleetError(f"{name} must be the path of a folder (got {path!r}).")
    return Path(path)


@contextmanager
def argument_names() -> Iterator[None]:
    """Name the argument `out` of a function in errors, in place of options of the command line."""
    try:
        yield
    except FleetError as error:
        if type(error) is not FleetError:
            raise
        text = str(error).replace(", or --overwrite to replace it", "").replace("--out", "out")
        raise FleetError(text) from error


@contextmanager
def new_folder(out: Path, kind: ResultKind, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that is renamed to `out` when the block succeeds, and removed when it fails.

    Raises:
        FleetError: `out` cannot be written, holds files that must not be replaced, or another process writes to it.
    """
    check_free(out, kind, overwrite=overwrite)
    target = Path(os.path.abspath(out))
    created = [parent for parent in target.parents if not parent.exists()]
    with disk_errors(out):
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        with lock_folder(work, out):
            _remove_drafts(target, work, out)
            yield work
            check_free(out, kind, overwrite=overwrite)  # again: another process may have written it meanwhile
            with disk_errors(out):
                work.chmod(0o755)
                replace_folder(work, target)
    finally:
        if work.exists():
            shutil.rmtree(work, ignore_errors=True)  # another process may remove it, too
            for parent in created:
                with suppress(OSError):  # another process has put a file there in the meantime
                    parent.rmdir()


def _remove_drafts(target: Path, work: Path, out: Path) -> None:
    """Remove the temporary folders of processes that were killed; raise a FleetError if another one is at work."""
    draft = re.compile(re.escape(f".{target.name}.") + "[a-z0-9_]{8}")  # as `mkdtemp` names them
    for other in target.parent.iterdir():
        if draft.fullmatch(other.name) and other != work and other.is_dir():
            with lock_folder(other, out), disk_errors(out):
                shutil.rmtree(other)


@contextmanager
def lock_folder(folder: Path, out: Path | None = None) -> Iterator[None]:
    """Lock a folder until the end of the block or of the process; no file is left in it.

    Args:
        out: For errors, if the user has given another folder.

    Raises:
        FleetError: another process has locked it, or it cannot be opened.
    """
    named = out or folder
    busy = FleetError(f"Another process writes to '{named}'. Wait for it, or choose another --out.")
    with disk_errors(named):
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            if out is None:
                raise
            raise busy from None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise busy from error
        if out and not folder.exists():
            raise busy
        yield
    finally:
        os.close(handle)


@contextmanager
def disk_errors(out: Path) -> Iterator[None]:
    """Turn an `OSError` into a `FleetError` that names the folder.

    Raises:
        FleetError: the folder cannot be read or written.
    """
    try:
        yield
    except OSError as error:
        raise FleetError(f"Cannot write to '{out}': {error.strerror or error}.") from error


@contextmanager
def new_file(out: Path) -> Iterator[Path]:
    """A temporary file that is renamed to `out` when the block succeeds; its folder is made.

    Raises:
        FleetError: `out` cannot be written.
    """
    with disk_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(out) as draft:
            yield draft


def check_free(out: Path, kind: ResultKind, *, overwrite: bool) -> None:
    """Check that a result may be written to `out`: it is free, or holds an earlier result of this kind.

    Raises:
        FleetError: names what is there and what is allowed.
    """
    with disk_errors(out):
        for parent in out.parents:
            if parent.exists() and not parent.is_dir():
                raise FleetError(f"Cannot write to '{out}': '{parent}' is a file, not a folder.")
        check_folder(out)
        if not out.exists():
            return
        present = sorted(p.name for p in out.iterdir())
    status = _status(out / kind.card)
    foreign = [name for name in present if not status or not any(fnmatchcase(name, known) for known in kind.files)]
    if foreign:
        raise FleetError(
            f"'{out}' holds other files ('{foreign[0]}'); --out needs a new folder or an earlier {kind.name}."
        )
    if status == "finished":
        check_overwrite(out, overwrite, f"holds a finished {kind.name}")


_FILE_TYPES = re.compile(
    r"\.(csv|tsv|xlsx?|ods|parquet|jsonl?|toml|yaml|txt|md|tex|pdf|html?|png|svg|jpe?g|gif|mp4|webm|mcap|glb|onnx|zip)",
    re.IGNORECASE,
)


def check_folder(out: Path, files: Sequence[str] = ()) -> None:
    """Raise a FleetError if `out`, the value of --out, is a file, or is new and ends as the name of one.

    Args:
        files: Endings of the files that the command writes in place of a folder.
    """
    if out.is_dir():
        return
    if out.exists():
        raise FleetError(f"Cannot write to '{out}': it is a file; --out needs a folder.")
    if _FILE_TYPES.fullmatch(out.suffix):
        also = f", or a file that ends in {', '.join(files)}" if files else ""
        raise FleetError(f"--out must be a folder, without the ending of a file{also} (got '{out}').")


def check_overwrite(out: Path, overwrite: bool, what: str = "exists", option: str = "--out") -> None:
    """Raise a FleetError if `out`, the value of an option, exists and must not be replaced."""
    if out.exists() and not overwrite:
        raise FleetError(f"'{out}' {what}; give another {option}, or --overwrite to replace it.")


def check_file(out: Path, endings: Sequence[str], overwrite: bool, option: str = "--out") -> None:
    """Raise a FleetError unless `out`, the value of an option, ends as asked, is no folder, and may be written."""
    if out.suffix.lower() not in endings:
        raise FleetError(f"{option} must end in {', '.join(endings)} (got '{out}').")
    if out.is_dir():
        raise FleetError(f"Cannot write to '{out}': it is a folder.")
    check_overwrite(out, overwrite, option=option)


def json_text(value: object) -> str:
    """A value as indented JSON that ends with a line break; NaN becomes null, NumPy arrays and numbers plain ones."""

    def plain(part: Any) -> object:  # an array or a number of NumPy
        return part.tolist()

    return msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=1).decode() + "\n"


def _status(card: Path) -> str | None:
    """The status on a card; None without a valid card."""
    try:
        status = json.loads(card.read_text(encoding="utf-8"))["status"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return status if status in ("finished", "interrupted") else None
