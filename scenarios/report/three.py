"""three.js, from the package `trimesh`, which carries it for its own viewer."""

import re
from functools import cache
from importlib.resources import files
from io import BytesIO
from zipfile import ZipFile

from fleet.errors import FleetError

_LIBRARY = re.compile(r"<script>(/\*\*\n \* @license\n \* Copyright [\d-]+ Three\.js Authors\n(?: \*[^\n]*\n)+[^\n]+)")
"""The licence, then the whole library on one line; trimesh's own viewer follows."""


@cache
def three_js() -> str:
    """Source of three.js; it defines the global `THREE`.

    Raises:
        FleetError: trimesh is not installed, or is a version that does not carry three.js.
    """
    try:
        packed = files("trimesh").joinpath("resources/templates/viewer.zip").read_bytes()
        page = ZipFile(BytesIO(packed)).read("viewer.html.template").decode()
    except (ModuleNotFoundError, FileNotFoundError, KeyError) as error:
        raise FleetError(f"Pages in 3-D need trimesh: pip install 'thermofleet[report]' ({error}).") from error
    found = _LIBRARY.search(page)
    if found is None:
        raise FleetError("This version of trimesh carries no three.js: pip install 'thermofleet[report]'.")
    return found[1]
