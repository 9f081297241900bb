"""Binary part of a glTF 2.0 file: accessors in one buffer, and the GLB container.

Source: Khronos Group, glTF 2.0 specification (ISO/IEC 12113:2022), sections 3.6 (binary data) and 4 (GLB).
"""

import json
import struct
from pathlib import Path
from typing import Any  # plain values of JSON

import numpy as np

Array = np.ndarray

VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
_COMPONENT = {"<f4": 5126, "<u2": 5123}
_TYPE = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
ALIGNMENT = 4


class Buffer:
    """The buffer of a file, filled array by array."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: Array, *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array and return the index of its accessor.

        Args:
            values: [element] or [element, component], of 1, 3 or 4 components; float32 or uint16 in the file.
            target: `VERTICES` or `INDICES`; None for animations.
            bounds: State least and largest values, which positions and times of animations need.
        """
        kind = "<u2" if values.dtype.kind in "iu" else "<f4"
        packed = np.ascontiguousarray(values, dtype=kind)
        raw = packed.tobytes()
        padded = raw + b"\0" * (-len(raw) % ALIGNMENT)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.size, "byteLength": len(raw)}
        self.views.append(view if target is None else view | {"target": target})
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _COMPONENT[kind],
            "count": len(packed),
            "type": _TYPE[packed.shape[1] if packed.ndim > 1 else 1],
        }
        if bounds:
            columns = packed.reshape(len(packed), -1)
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        self._parts.append(padded)
        self.size += len(padded)
        return len(self.accessors) - 1

    def write(self, path: Path, content: dict[str, Any]) -> None:
        """Write the file.

        Args:
            content: Its JSON part, without buffers, views and accessors.
        """
        whole = content | {
            "buffers": [{"byteLength": self.size}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % ALIGNMENT)
        length = 12 + 8 + len(text) + 8 + self.size
        with path.open("wb") as file:
            file.write(struct.pack("<III", _MAGIC, _VERSION, length))
            file.write(struct.pack("<II", len(text), _JSON) + text)
            file.write(struct.pack("<II", self.size, _BIN))
            file.writelines(self._parts)
