"""A saturation model in a file beside its twin: `saturation.json`, plain numbers."""

import os
from pathlib import Path

import msgspec

from fleet.errors import CheckpointError
from twin.saturation import CalibratedTwin, SaturationModel
from twin.score import Twin

FORMAT = 1
FILE = "saturation.json"


class _Head(msgspec.Struct):
    """What must be known before the rest can be read."""

    format: int


class _Card(msgspec.Struct, forbid_unknown_fields=True):
    """The content of the file."""

    format: int
    version: str
    model: SaturationModel


def save_saturation(model: SaturationModel, folder: Path) -> None:
    """Write the model into the folder of its twin, made if need be. The file appears whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    card = _Card(FORMAT, model.version, model)
    unfinished = folder / f".{FILE}.{os.getpid()}"
    unfinished.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2))
    unfinished.replace(folder / FILE)


def load_saturation(folder: Path) -> SaturationModel:
    """The model that `save_saturation` wrote, with the same probabilities to the last bit.

    Raises:
        CheckpointError: the file is missing or damaged, of another format, or not what was saved.
    """
    path = folder / FILE
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"No saturation model in {folder}: {FILE} is missing.") from None
    try:
        head = msgspec.json.decode(text, type=_Head)
        if head.format != FORMAT:
            raise CheckpointError(f"{path}: format {head.format} is not the one read here, {FORMAT}.")
        card = msgspec.json.decode(text, type=_Card)
    except msgspec.DecodeError as error:  # not JSON, or (ValidationError) JSON of another shape
        raise CheckpointError(f"{path}: {error}") from error
    if card.model.version != card.version:
        raise CheckpointError(
            f"{path}: the content has changed since it was saved (says version {card.version}, is "
            f"{card.model.version})."
        )
    return card.model


def load_calibrated(twin: Twin, folder: Path, *, data_hash: str | None = None) -> CalibratedTwin:
    """The twin with the model that was saved in the folder.

    Args:
        data_hash: `Experience.data_hash` of the past jobs that the model must come from; None takes any.

    Raises:
        CheckpointError: as `load_saturation`, or the model is of another twin or of other past jobs.
    """
    model = load_saturation(folder)
    for what, found, wanted in (
        ("twin", model.twin, twin.version),
        ("data_hash", model.data_hash, data_hash or model.data_hash),
        ("joints", len(model.of_temp), twin.joints),
    ):
        if found != wanted:
            raise CheckpointError(f"{folder / FILE}: {what} is {found}, wanted {wanted}. Fit the model anew.")
    return CalibratedTwin(twin, model)
