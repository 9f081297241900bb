"""An identified arm in one file, `rc.json`: readable numbers with their intervals, and what they came from."""

from pathlib import Path
from typing import Any

import msgspec
import networkx as nx
import numpy as np

from fleet.errors import CheckpointError
from fleet.motor import Motors
from fleet.robot import JOINTS
from fleet.thermal import thermal_model
from twin.card import check_version, read_card, write_card
from twin.heat_log import Source
from twin.identified import Identified, Parameter
from twin.rc import RcTwin
from twin.rc_risk import MarginHead
from twin.thermal_values import Body

FORMAT = 1
CARD = "rc.json"


class _Card(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `rc.json`."""

    format: int
    version: str
    arm: str
    data_hash: str
    ambient_c: float
    ambient_sd_k: float
    source: Source
    seconds: float
    parameters: list[Parameter]
    rms_k: dict[str, tuple[float, ...]]
    memory_s: tuple[float, ...]
    motors: dict[str, float | list[float]]
    capacity_j_per_k: dict[str, float]
    conductance_w_per_k: list[tuple[str, str, float]]
    saturation: MarginHead | None = None


def save(identified: Identified, folder: Path, *, saturation: MarginHead | None = None) -> None:
    """Write an identified arm into a folder, made if need be, with its P(saturation) if there is one.

    The file appears whole or not at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network = identified.body.network
    capacity: Any = network.nodes(data="capacity_j_per_k")
    card = _Card(
        format=FORMAT,
        version=identified.version,
        arm=identified.arm,
        data_hash=identified.data_hash,
        ambient_c=identified.ambient_c,
        ambient_sd_k=identified.ambient_sd_k,
        source=identified.source,
        seconds=identified.seconds,
        parameters=list(identified.parameters),
        rms_k=identified.rms_k,
        memory_s=identified.memory_s,
        motors={name: np.asarray(value).tolist() for name, value in vars(identified.body.motors).items()},
        capacity_j_per_k={name: value for name, value in capacity if value is not None},
        conductance_w_per_k=list(network.edges(data="conductance_w_per_k")),
        saturation=saturation,
    )
    write_card(card, folder / CARD)


def load(folder: Path) -> Identified:
    """The identified arm that `save` wrote.

    Raises:
        CheckpointError: the file is missing, damaged, of another format or for another number of joints, or its
            numbers are not those that were saved.
    """
    return _identified(_read(folder / CARD), folder / CARD)


def load_twin(folder: Path) -> RcTwin:
    """The physical twin of what `save` wrote, with P(saturation) if it was saved.

    Raises:
        CheckpointError: as `load`.
    """
    card = _read(folder / CARD)
    twin = RcTwin.of(_identified(card, folder / CARD))
    return twin.with_head(card.saturation)


def _read(path: Path) -> _Card:
    return read_card(path, _Card, format_=FORMAT, what="identified arm")


def _identified(card: _Card, path: Path) -> Identified:
    widths = {name: len(value) for name, value in card.motors.items() if isinstance(value, list)}
    if wrong := {name: width for name, width in widths.items() if width != JOINTS}:
        raise CheckpointError(f"{path}: motors must have {JOINTS} joints, not so: {wrong}.")
    graph = nx.Graph()
    graph.add_node("ambient")
    for name, value in card.capacity_j_per_k.items():
        graph.add_node(name, capacity_j_per_k=value)
    for one, other, value in card.conductance_w_per_k:
        graph.add_edge(one, other, conductance_w_per_k=value)
    values: dict[str, Any] = {n: np.array(v) if isinstance(v, list) else v for n, v in card.motors.items()}
    try:
        thermal_model(graph)
        motors = Motors(**values)
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    found = Identified(
        arm=card.arm,
        body=Body(motors, graph),
        parameters=tuple(card.parameters),
        ambient_c=card.ambient_c,
        ambient_sd_k=card.ambient_sd_k,
        source=card.source,
        rms_k=card.rms_k,
        memory_s=card.memory_s,
        seconds=card.seconds,
        data_hash=card.data_hash,
    )
    check_version(path, card.version, found.version)
    return found
