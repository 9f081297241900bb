"""What the replay of a page reads: movement and temperatures of a shift, packed, and three.js."""

import base64
import gzip
import io
import json
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any  # plain values of JSON
from zipfile import ZipFile

import numpy as np

from fleet.errors import FleetError, install
from fleet.telemetry import Telemetry

Array = np.ndarray

MOST_VALUES = 3_000_000
"""Joint angles in a page; longer shifts of larger fleets keep fewer moments."""
HEAT_STEP_S = 10.0
"""Motors take minutes to heat up; temperatures keep one moment in this time."""
ANGLE_RAD, HEAT_C, LOAD_KG = 1e-3, 0.1, 0.01
"""Resolution."""
_LIBRARY = re.compile(r"<script>(/\*\*\n \* @license\n \* Copyright [\d-]+ Three\.js Authors\n(?: \*[^\n]*\n)+[^\n]+)")
"""The licence, then the whole library on one line; trimesh's own viewer follows."""


def packed(telemetry: Telemetry, payload_kg: Array | None = None) -> str:
    """Angles, temperatures, modes and payloads of a shift as text: base64 of a gzip stream.

    The stream is a line of JSON that lists the arrays (name, shape, scale, first moment and step in s), then their
    values: 16-bit little-endian integers, [arm, joint, moment] or [arm, moment], each but the first as the
    difference to its predecessor along the moments, modulo 2^16.

    Args:
        telemetry: At least one sample, equally spaced in time. An arm that is absent (NaN) keeps its last values, and
            its mode is -1.
        payload_kg: [sample, arm]; no payloads by default.
    """
    samples, arms = telemetry.mode.shape
    time_s = telemetry.time_s
    step_s = float(np.median(np.diff(time_s))) if samples > 1 else 1.0
    dense = max(1, -(-telemetry.q.size // MOST_VALUES))
    sparse = max(1, round(HEAT_STEP_S / step_s))
    mode = np.where(np.isfinite(telemetry.q[..., 0]), telemetry.mode, np.int8(-1))
    load = np.zeros((samples, arms), np.float32) if payload_kg is None else payload_kg
    arrays = [
        ("q", telemetry.q, ANGLE_RAD, dense),
        ("temp_c", telemetry.temp_c, HEAT_C, sparse),
        ("mode", mode, 1.0, dense),
        ("payload_kg", load, LOAD_KG, dense),
    ]
    listed: list[dict[str, Any]] = [
        {
            "name": name,
            "shape": (arms, *values.shape[2:], len(time_s[::stride])),
            "scale": scale,
            "first_s": float(time_s[0]),
            "step_s": stride * step_s,
        }
        for name, values, scale, stride in arrays
    ]

    def body() -> Iterator[bytes]:
        for _, values, scale, stride in arrays:
            for arm in range(arms):  # one at a time, as large fleets have much
                steps = np.clip(np.round(_held(values[::stride, arm]) / scale), -(2**15), 2**15 - 1)
                yield np.diff(steps.astype(np.int32).T, axis=-1, prepend=0).astype("<i2").tobytes()

    return compressed(chain([json.dumps(listed, separators=(",", ":")).encode() + b"\n"], body()))


def compressed(content: Iterable[bytes]) -> str:
    """Bytes, in pieces, as base64 of a gzip stream; the same content gives the same text."""
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", compresslevel=9, mtime=0) as file:
        for piece in content:
            file.write(piece)
    return base64.b64encode(packed.getbuffer()).decode("ascii")


def _held(values: Array) -> Array:
    """Values along the first axis, NaN replaced by the last value before it, or the first after it."""
    values = np.array(values, dtype=float)
    if np.isfinite(values).all():
        return values
    flat = values.reshape(len(values), -1)
    for column in flat.T:
        known = np.flatnonzero(np.isfinite(column))
        last = np.searchsorted(known, np.arange(len(column)), side="right") - 1
        column[:] = column[known[np.maximum(last, 0)]] if len(known) else 0.0
    return flat.reshape(values.shape)


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
