"""Cache folders, and files that are written atomically."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def cache_folder() -> Path:
    """Folder of plans and twins: $THERMOFLEET_CACHE, else thermofleet in $XDG_CACHE_HOME or ~/.cache."""
    own = os.environ.get("THERMOFLEET_CACHE")
    return Path(own) if own else user_cache_folder()


def user_cache_folder() -> Path:
    """Folder of compiled code, shared by all studies: thermofleet in $XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "thermofleet"


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a draft path beside `path`; the draft replaces `path` when the block ends without an error.

    After an error `path` is as it was before, and the draft is removed.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
