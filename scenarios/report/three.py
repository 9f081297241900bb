"""three.js, from the package `trimesh`, which carries it for its own viewer."""

import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from zipfile import ZipFile

from fleet.errors import FleetError, install

_LIBRARY = re.compile(r"<script>(/\*\*\n \* @license\n \* Copyright [\d-]+ Three\.js Authors\n(?: \*[^\n]*\n)+[^\n]+)")
"""The licence, then the whole library on one line; trimesh's own viewer follows."""


@cache
def three_js() -> str:
    """Source of three.js; it defines the global `THREE`.

    Raises:
        FleetError: trimesh is not installed, or is a version that does not carry three.js.
    """
    try:
        package = find_spec("trimesh")  # not imported, which would take 50 MB
        if package is None or package.origin is None:
            raise ModuleNotFoundError("it is not installed")
        with ZipFile(Path(package.origin).parent / "resources/templates/viewer.zip") as packed:
            page = packed.read("viewer.html.template").decode()
    except (ModuleNotFoundError, FileNotFoundError, KeyError) as error:
        raise FleetError(f"Pages in 3-D need trimesh: {install('report')} ({error}).") from error
    found = _LIBRARY.search(page)
    if found is None:
        raise FleetError(f"This version of trimesh carries no three.js: {install('report')}.")
    return found[1]
