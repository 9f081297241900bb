"""Cache folders, and files that are written atomically."""

import codecs
import errno
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fleet.errors import FleetError

_NO_UTF8 = re.compile("[\udc80-\udcff]+")
"""How Python keeps such bytes."""


def decode_text(content: bytes) -> str:
    """The text of a table that people exchange: UTF-8 or, with a byte order mark, UTF-16.

    Bytes that are no UTF-8 are taken for Windows-1252, which old spreadsheets write, also among UTF-8.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    text = content.decode("utf-8-sig", errors="surrogateescape")
    if text.isascii():  # the search below takes seconds for 100 MB
        return text
    return _NO_UTF8.sub(lambda found: found[0].encode("utf-8", "surrogateescape").decode("cp1252", "replace"), text)


def cache_folder() -> Path:
    """Folder of plans and twins: $THERMOFLEET_CACHE, else thermofleet in $XDG_CACHE_HOME or ~/.cache.

    Raises:
        FleetError: as `private_folder`.
    """
    own = os.environ.get("THERMOFLEET_CACHE")
    return private_folder(Path(own)) if own else user_cache_folder()


def user_cache_folder() -> Path:
    """Folder of compiled code, shared by all studies: thermofleet in $XDG_CACHE_HOME or ~/.cache.

    Raises:
        FleetError: as `private_folder`.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    return private_folder((Path(base) if base else Path.home() / ".cache") / "thermofleet")


def private_folder(path: Path) -> Path:
    """Make a folder with mode 700 and return it. Compiled code in a cache is executed, so only its owner may write to
    it.

    Raises:
        FleetError: it belongs to another user, or cannot be made.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise FleetError(
            f"Cannot keep plans and twins in '{path}': {error.strerror}. Set THERMOFLEET_CACHE and XDG_CACHE_HOME to "
            "folders that you may write to."
        ) from error
    status = path.stat()
    if os.name == "posix":
        if status.st_uid != os.geteuid():
            raise FleetError(
                f"The cache '{path}' belongs to another user, who could run code as you. Set THERMOFLEET_CACHE and "
                "XDG_CACHE_HOME to folders of your own."
            )
        if status.st_mode & 0o077:
            path.chmod(0o700)
    return path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a draft path beside `path`; the draft replaces `path` when the block ends without an error.

    After an error `path` is as it was before, and the draft is removed. Of a link, its target is replaced.

    Raises:
        OSError: `path` is a device or another special file.
    """
    path = path.resolve()
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    draft = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def replace_folder(work: Path, place: Path) -> None:
    """Rename the folder `work` to `place`; after an error the previous folder is still there."""
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
