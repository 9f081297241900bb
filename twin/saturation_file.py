"""A saturation model in a file beside its twin: `saturation.json`, plain numbers."""

from pathlib import Path

import msgspec

from fleet.errors import CheckpointError
from twin.card import check_version, read_card, write_card
from twin.saturation import CalibratedTwin, SaturationModel
from twin.score import Twin

FORMAT = 1
FILE = "saturation.json"


class _Card(msgspec.Struct, forbid_unknown_fields=True):
    """The content of the file."""

    format: int
    version: str
    model: SaturationModel


def save_saturation(model: SaturationModel, folder: Path) -> None:
    """Write the model into the folder of its twin, made if need be. The file appears whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    card = _Card(FORMAT, model.version, model)
    write_card(card, folder / FILE)


def load_saturation(folder: Path) -> SaturationModel:
    """The model that `save_saturation` wrote, with the same probabilities to the last bit.

    Raises:
        CheckpointError: the file is missing or damaged, of another format, or not what was saved.
    """
    path = folder / FILE
    card = read_card(path, _Card, format_=FORMAT, what="saturation model")
    check_version(path, card.version, card.model.version)
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
