"""A twin in a folder: `weights.safetensors` and `twin.json`, neither of which can run code when read."""

from pathlib import Path

import msgspec
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.robot import JOINTS
from twin.json_file import check_version, read_card, write_card
from twin.vae.measures import PARTS, Calibration, Features
from twin.vae.model import LstmVae, TwinConfig, build
from twin.vae.twin import Fit, Twin, net_names
from twin.vae.window import Scaler

FORMAT = 2
WEIGHTS = "weights.safetensors"
CARD = "twin.json"
REFERENCE = "calibration.reference"
"""Tensor with the features of held-out cool jobs, float64 [job, joint, part]; absent without a calibration."""


class _Card(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `twin.json`."""

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
    fits: list[Fit]
    calibrated: bool


def save(twin: Twin, folder: Path) -> None:
    """Write the twin into a folder, made if need be; each file is written atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    card = _Card(
        format=FORMAT,
        version=twin.version,
        arm=twin.arm,
        data_hash=twin.data_hash,
        seed=twin.seed,
        config=twin.config,
        turn_q=twin.scaler.turn_q.tolist(),
        mean=twin.scaler.mean.tolist(),
        std=twin.scaler.std.tolist(),
        still=twin.scaler.still.tolist(),
        fits=list(twin.fits),
        calibrated=twin.calibration is not None,
    )
    tensors = twin.tensors()
    if twin.calibration is not None:
        tensors[REFERENCE] = torch.from_numpy(np.array(twin.calibration.reference.packed, dtype=float))
    with atomic_path(folder / WEIGHTS) as draft:
        save_file(tensors, draft)
    write_card(card, folder / CARD)


def load(folder: Path, *, joints: int = JOINTS) -> Twin:
    """The twin that `save` wrote, with the same scores to the last bit.

    Raises:
        CheckpointError: a file is missing or damaged, of another format, for another number of joints, lacks
            tensors, or is not what was saved.
    """
    card = read_card(folder / CARD, _Card, format_=FORMAT, what="twin")
    if len(card.turn_q) != joints:
        raise CheckpointError(f"{folder / CARD}: the twin has {len(card.turn_q)} joints, the arm has {joints}.")
    scaler = Scaler(np.array(card.turn_q), np.array(card.mean), np.array(card.std), np.array(card.still))
    if {len(part) for part in (scaler.mean, scaler.std, scaler.still)} != {joints}:
        raise CheckpointError(f"{folder / CARD}: mean, std and still must each have {joints} joints.")
    networks = card.config.networks(joints)
    if len(card.fits) != networks:
        raise CheckpointError(f"{folder / CARD}: fits must have {networks} entries, one per network.")
    tensors = _read_tensors(folder / WEIGHTS)
    calibration = _calibration(folder / WEIGHTS, tensors, joints) if card.calibrated else None
    twin = Twin(
        card.config,
        scaler,
        _nets(folder / WEIGHTS, tensors, card.config, joints),
        arm=card.arm,
        data_hash=card.data_hash,
        seed=card.seed,
        fits=card.fits,
        calibration=calibration,
    )
    check_version(folder, card.version, twin.version)
    return twin


def _read_tensors(path: Path) -> dict[str, torch.Tensor]:
    if not path.exists():
        raise CheckpointError(f"No twin in {path.parent}: {path.name} is missing.")
    try:
        return load_file(path)
    except SafetensorError as error:
        raise CheckpointError(f"{path}: damaged ({error}).") from error


def _calibration(path: Path, tensors: dict[str, torch.Tensor], joints: int) -> Calibration:
    """The calibration, removed from the tensors."""
    reference = tensors.pop(REFERENCE, None)
    if reference is None:
        raise CheckpointError(f"{path}: missing tensors ['{REFERENCE}'].")
    if reference.dtype != torch.float64 or reference.ndim != 3 or tuple(reference.shape[1:]) != (joints, PARTS):
        raise CheckpointError(
            f"{path}: tensor {REFERENCE} is {reference.dtype} {tuple(reference.shape)}, "
            f"it must be {torch.float64} (jobs, {joints}, {PARTS})."
        )
    try:
        return Calibration(Features(reference.numpy()))
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error


def _nets(path: Path, tensors: dict[str, torch.Tensor], config: TwinConfig, joints: int) -> list[LstmVae]:
    channels = config.channels(joints)
    nets = {name: build(config, seed=0, channels=channels) for name in net_names(config, joints)}
    wanted = {f"{owner}.{name}": tensor for owner, net in nets.items() for name, tensor in net.state_dict().items()}
    missing, unknown = sorted(wanted.keys() - tensors.keys()), sorted(tensors.keys() - wanted.keys())
    if missing or unknown:
        raise CheckpointError(f"{path}: missing tensors {missing[:3]}, unknown tensors {unknown[:3]}.")
    for name, tensor in wanted.items():
        if tensors[name].shape != tensor.shape or tensors[name].dtype != tensor.dtype:
            raise CheckpointError(
                f"{path}: tensor {name} is {tensors[name].dtype} {tuple(tensors[name].shape)}, "
                f"the configuration needs {tensor.dtype} {tuple(tensor.shape)}."
            )
        tensor.copy_(tensors[name])
    return list(nets.values())
