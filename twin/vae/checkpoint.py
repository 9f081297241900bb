"""A twin in a folder: `weights.safetensors` and `twin.json`, neither of which can run code when read."""

from dataclasses import fields
from pathlib import Path

import msgspec
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.robot import JOINTS
from twin.json_file import check_version, read_card, write_card
from twin.vae.config import TwinConfig
from twin.vae.inference import shapes
from twin.vae.measures import Calibration, Features
from twin.vae.twin import Fit, Twin, net_names
from twin.vae.window import Scaler

Array = np.ndarray

FORMAT = 3
WEIGHTS = "weights.safetensors"
CARD = "twin.json"
REFERENCE, GROUP = "calibration.reference", "calibration.group"
"""Tensors with the features of held-out cool jobs, float64 [job, joint, part], and their kinds, int64 [job]; absent
without a calibration."""


class _Card(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `twin.json`; the names are those of `Twin` and `Scaler`."""

    format: int
    version: str
    arm: str
    data_hash: str
    seed: str
    config: TwinConfig
    turn_q: list[float]
    mean: list[tuple[float, float, float]]
    std: list[tuple[float, float, float]]
    still: list[bool]
    fits: tuple[Fit, ...]
    calibrated: bool


_SHARED = ("config", "arm", "data_hash", "seed", "fits")


def save(twin: Twin, folder: Path) -> None:
    """Write the twin into a folder, made if need be; each file is written atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = twin.tensors()
    if twin.calibration is not None:
        tensors[REFERENCE] = np.array(twin.calibration.reference.packed, dtype=float)
        tensors[GROUP] = np.array(twin.calibration.group, dtype=np.int64)
    with atomic_path(folder / WEIGHTS) as draft:
        save_file(tensors, draft)
    shared = {name: getattr(twin, name) for name in _SHARED}
    scaler = {name: values.tolist() for name, values in vars(twin.scaler).items()}
    calibrated = twin.calibration is not None
    write_card(_Card(format=FORMAT, version=twin.version, calibrated=calibrated, **shared, **scaler), folder / CARD)


def load(folder: Path, *, joints: int = JOINTS) -> Twin:
    """The twin that `save` wrote, with the same scores to the last bit.

    Raises:
        CheckpointError: a file is missing or damaged, of another format, for another number of joints, lacks
            tensors, or is not what was saved.
    """
    card = read_card(folder / CARD, _Card, format_=FORMAT, what="twin")
    if len(card.turn_q) != joints:
        raise CheckpointError(f"{folder / CARD}: the twin has {len(card.turn_q)} joints, the arm has {joints}.")
    scaler = Scaler(*(np.array(getattr(card, field.name)) for field in fields(Scaler)))
    if {len(part) for part in (scaler.mean, scaler.std, scaler.still)} != {joints}:
        raise CheckpointError(f"{folder / CARD}: mean, std and still must each have {joints} joints.")
    wanted = shapes(card.config, card.config.channels(joints))
    try:
        tensors = load_file(folder / WEIGHTS)
        calibration = Calibration(Features(tensors.pop(REFERENCE)), tensors.pop(GROUP)) if card.calibrated else None
        nets = [
            {name: _tensor(tensors, f"{net}.{name}", shape) for name, shape in wanted.items()}
            for net in net_names(card.config, joints)
        ]
        if tensors:
            raise ValueError(f"unknown tensors {', '.join(sorted(tensors))}")
        shared = {name: getattr(card, name) for name in _SHARED}
        twin = Twin(scaler=scaler, nets=tuple(nets), calibration=calibration, **shared)
    except FileNotFoundError:
        raise CheckpointError(f"No twin in {folder}: {WEIGHTS} is missing.") from None
    except KeyError as error:
        raise CheckpointError(f"{folder / WEIGHTS}: missing tensor {error}.") from error
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"{folder / WEIGHTS} does not fit {CARD}: {' '.join(str(error).split())}") from error
    check_version(folder, card.version, twin.version)
    return twin


def _tensor(tensors: dict[str, Array], name: str, shape: tuple[int, ...]) -> Array:
    """Take a tensor out; raises KeyError or ValueError."""
    tensor = tensors.pop(name)
    if tensor.shape != shape or tensor.dtype != np.float32:
        raise ValueError(f"'{name}' is {tensor.dtype} {list(tensor.shape)}, not float32 {list(shape)}")
    return tensor
