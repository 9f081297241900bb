"""An identified arm in one file, `rc.json`: readable numbers with their intervals and their origin."""

from collections.abc import Callable
from pathlib import Path
from typing import cast

import msgspec
import networkx as nx
import numpy as np

from fleet.errors import CheckpointError
from fleet.heat.motor import Motors
from fleet.heat.thermal import thermal_model
from fleet.json_file import check_version, read_card, write_card
from fleet.robot import JOINTS
from twin.logs.recording import CurrentSource
from twin.thermal.identify import HeatModel, Identified, Parameter
from twin.thermal.thermal_twin import PeakCurve

FORMAT = 2
CARD, CURVE = "rc.json", "saturation_curve.json"


class NetworkCard(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `rc.json`."""

    format: int
    version: str
    arm: str
    data_hash: str
    ambient_c: float
    ambient_sd_k: float
    source: CurrentSource
    seconds: float
    parameters: tuple[Parameter, ...]
    rms_k: dict[str, tuple[float, ...]]
    memory_s: tuple[float, ...]
    motors: dict[str, float | list[float]]
    capacity_j_per_k: dict[str, float]
    conductance_w_per_k: list[tuple[str, str, float]]
    information: bytes | None = None
    """Of `Identified`, float32 in little-endian order; None in files of earlier versions."""
    saturation: None = None
    """Kept because stored files name it; P(saturation) is in `saturation_curve.json`."""


_SHARED = ("arm", "data_hash", "ambient_c", "ambient_sd_k", "source", "seconds", "parameters", "rms_k", "memory_s")


def save(identified: Identified, folder: Path) -> None:
    """Write an identified arm atomically into a folder, made if need be."""
    network = identified.heat_model.network
    card = NetworkCard(
        format=FORMAT,
        version=identified.version,
        motors={name: np.asarray(value).tolist() for name, value in vars(identified.heat_model.motors).items()},
        capacity_j_per_k={name: node["capacity_j_per_k"] for name, node in network.nodes.items() if node},
        conductance_w_per_k=list(network.edges(data="conductance_w_per_k")),
        information=None if identified.information is None else identified.information.astype("<f4").tobytes(),
        **{name: getattr(identified, name) for name in _SHARED},
    )
    write_card(card, folder / CARD)


def load(folder: Path) -> Identified:
    """The identified arm that `save` wrote; the folder, or the file in it.

    Raises:
        CheckpointError: the file is missing, damaged, of another format or for another number of joints, or its
            numbers are not those that were saved.
    """
    path = folder if folder.name == CARD else folder / CARD
    card = read_card(path, NetworkCard, format_=FORMAT, what="identified arm")
    widths = {name: len(value) for name, value in card.motors.items() if isinstance(value, list)}
    if wrong := {name: width for name, width in widths.items() if width != JOINTS}:
        raise CheckpointError(f"{path}: motors must have {JOINTS} joints (got {wrong}).")
    graph = nx.Graph()
    graph.add_node("ambient")
    for name, value in card.capacity_j_per_k.items():
        graph.add_node(name, capacity_j_per_k=value)
    graph.add_weighted_edges_from(card.conductance_w_per_k, weight="conductance_w_per_k")
    values = {name: np.array(value) if isinstance(value, list) else value for name, value in card.motors.items()}
    information, free = None, len(card.parameters)
    try:
        if card.information is not None:
            information = np.frombuffer(card.information, "<f4").reshape(free, free)
            np.linalg.cholesky(information.T.astype(float) @ information)  # raises LinAlgError if it is singular
            if not np.isfinite(information).all():
                raise ValueError("information must be finite.")
        thermal_model(graph)
        motors = cast("Callable[..., Motors]", Motors)(**values)  # names and values of a file, checked by Motors
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    shared = {name: getattr(card, name) for name in _SHARED}
    identified = Identified(heat_model=HeatModel(motors, graph), information=information, **shared)
    check_version(path, card.version, identified.version)
    return identified


class CurveCard(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `saturation_curve.json`."""

    format: int
    curve: PeakCurve


def save_curve(curve: PeakCurve, folder: Path) -> None:
    """Write the curve of a thermal twin atomically into a folder, made if need be."""
    write_card(CurveCard(FORMAT, curve), folder / CURVE)


def load_curve(folder: Path) -> PeakCurve:
    """The curve that `save_curve` wrote; raises as `load`."""
    return read_card(folder / CURVE, CurveCard, format_=FORMAT, what="curve of P(saturation)").curve
