"""The latent plane of the joint that carries the load, with the verdicts on jobs, as a PNG."""

import io
import textwrap

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from fleet.errors import FleetError
from twin.vae.measures import Features
from twin.verdict import ANOMALOUS, UNCRITICAL, Rule

Array = np.ndarray

RADII = (1.0, 2.0)
"""Mahalanobis distances that are drawn round the cool jobs."""
BLUE, ORANGE, GREY, INK = "#0072B2", "#D55E00", "#8A8A8A", "#222222"
"""Uncritical, anomalous, held-out, ellipses; of Okabe and Ito, for colour-blind readers."""
DPI = 110
TITLE_CHARACTERS = 63
"""Characters of a title in one line."""


def verdict_png(rule: Rule, features: Features) -> bytes:
    """Mean latent of each job [job, joint] by verdict, over the cool jobs that calibrated the twin and their cluster.

    The same figure gives the same bytes.

    Raises:
        FleetError: the twin has one latent unit.
    """
    calibration, joint = rule.calibration, int(np.argmax(rule.twin.joint_weight))
    if features.latent < 2:
        raise FleetError(f"A latent map needs two units or more (the twin has {features.latent}).")
    anomalous = rule.anomalous(features)
    count = int(anomalous.sum())
    title = f"Joint {joint + 1}: {count} of {len(anomalous)} are anomalous at {rule.alpha:g} by {rule.reading}"
    figure = Figure(figsize=(7.5, 6.0), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    figure.suptitle(textwrap.fill(title, TITLE_CHARACTERS), fontweight="bold", color=INK, x=0.01, ha="left")
    centre, inverse = (each[joint] for each in calibration.cluster)
    known, own = (each.latent_moments[0][:, joint, :2] for each in (calibration.reference, features))
    axes.scatter(*known.T, s=14, color=GREY, alpha=0.6, linewidths=0, label="held-out cool jobs")
    kinds = ((~anomalous, BLUE, UNCRITICAL, "o"), (anomalous, ORANGE, ANOMALOUS, "^"))
    for kind, colour, name, mark in kinds:
        axes.scatter(*own[kind].T, s=26, color=colour, marker=mark, alpha=0.8, linewidths=0, label=name)
    for radius in RADII:
        axes.add_patch(_ellipse(centre[:2], np.linalg.inv(inverse)[:2, :2], radius))
    axes.set(xlabel=f"μ₁ of joint {joint + 1}", ylabel=f"μ₂ of joint {joint + 1}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def _ellipse(centre: Array, covariance: Array, radius: float) -> Ellipse:
    values, vectors = np.linalg.eigh(covariance)
    wide, tall = (2 * radius * np.sqrt(values)).tolist()
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    at = tuple(centre.tolist())
    return Ellipse(at, wide, tall, angle=angle, fill=False, edgecolor=INK, linewidth=0.9, linestyle="--")  # pyright: ignore[reportArgumentType]
