"""Write generated motion and recoveries atomically as folders; column names hold the units."""

import json
from pathlib import Path
from typing import Any, Literal  # Any: values of the JSON card

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

from fleet.motion import RATE_HZ, Plan
from fleet.robot import JOINTS
from scenarios.motion.generate import Generated
from scenarios.motion.recover import Recovery
from scenarios.result_folder import ResultKind, new_folder
from twin.vae.window import PHASES

Array = np.ndarray
Format = Literal["parquet", "csv"]

GENERATED = ResultKind(
    name="generation", card="generated.json", files=("generated.json", "motion_*.parquet", "motion_*.csv")
)
"""One table per motion, and a card with sources and rejections."""
RECOVERY = ResultKind(
    name="recovery", card="recovery.json", files=("recovery.json", "recovery.parquet", "recovery.csv")
)
"""Temperatures with and without recovery, and a card with the postures."""


def save_generated(made: Generated, out: Path, *, format: Format = "parquet", overwrite: bool = False) -> None:
    """Write `motion_000` and so on, and `generated.json`.

    Raises:
        FleetError: `out` cannot be written, or holds something that is not ours to replace.
    """
    with new_folder(out, GENERATED, overwrite=overwrite) as folder:
        for i, motion in enumerate(made.motions):
            _write(motion_table(motion.plan), folder / f"motion_{i:03d}.{format}")
        _write_card(generated_summary(made, format), folder / GENERATED.card)


def save_recovery(recovery: Recovery, out: Path, *, format: Format = "parquet", overwrite: bool = False) -> None:
    """Write `recovery.parquet` (or .csv) and `recovery.json`.

    Raises:
        FleetError: `out` cannot be written, or holds something that is not ours to replace.
    """
    with new_folder(out, RECOVERY, overwrite=overwrite) as folder:
        _write(recovery_table(recovery), folder / f"recovery.{format}")
        _write_card(recovery_summary(recovery), folder / RECOVERY.card)


def motion_table(plan: Plan) -> pa.Table:
    """A plan as one row per sample: time_s, phase, payload_kg, q_1_rad …, qd_1_rad_s …, tau_1_nm …"""
    profile = np.concatenate([phase.profile for phase in plan.phases])
    lengths = [len(phase.profile) for phase in plan.phases]
    return pa.table(
        {
            "time_s": np.arange(len(profile)) / RATE_HZ,
            "phase": np.repeat(PHASES, lengths),
            "payload_kg": np.concatenate([phase.payload_kg for phase in plan.phases]),
            **_by_joint("q", "_rad", profile[:, 0]),
            **_by_joint("qd", "_rad_s", profile[:, 1]),
            **_by_joint("tau", "_nm", profile[:, 2]),
        }
    )


def recovery_table(recovery: Recovery) -> pa.Table:
    """Winding temperatures as one row per moment: time_s, without_1_c …, with_1_c …"""
    temperatures = {**_by_joint("without", "_c", recovery.without_c), **_by_joint("with", "_c", recovery.with_c)}
    return pa.table({"time_s": recovery.time_s, **temperatures})


def _by_joint(name: str, unit: str, values: Array) -> dict[str, Array]:
    """Columns `name_1unit` … of values [row, joint]."""
    return {f"{name}_{j + 1}{unit}": values[:, j] for j in range(JOINTS)}


def generated_summary(made: Generated, format: Format = "parquet") -> dict[str, Any]:
    """Motions, sources and rejections as plain values."""
    return {
        "status": "finished",
        "arm": made.arm,
        "twin": made.twin_version,
        "s": made.s,
        "seed": made.seed,
        "asked": made.asked,
        "handed_out": len(made.motions),
        "rejected": dict(made.rejected),
        "truly_cool": made.truly_cool,
        **{name: getattr(made.verification, name) for name in ("cool_c", "margin_k", "horizon_s", "ambient_c")},
        "rate_hz": RATE_HZ,
        "motions": [
            {
                "file": f"motion_{i:03d}.{format}",
                "source": {
                    "kind": motion.source.work.kind,
                    "places": list(motion.source.work.stations),
                    "elbow": motion.source.elbow,
                    "speed": motion.source.speed,
                },
                "payload_kg": motion.source.work.payload_kg,
                "duration_s": motion.plan.duration_s(1),
                "distance_rad": motion.distance_rad,
                "distance_z": motion.distance_z,
                "predicted_peak_c": float(motion.predicted_c.max()),
                "true_peak_c": float(motion.peak_c.max()),
                "tracking_error_rad": motion.error_rad,
            }
            for i, motion in enumerate(made.motions)
        ],
    }


def recovery_summary(recovery: Recovery) -> dict[str, Any]:
    """The recovery as plain values; joints are counted from one."""
    return {
        "status": "finished",
        "arm": recovery.arm,
        "twin": recovery.twin_version,
        "payload_kg": recovery.payload_kg,
        "hottest_joint": recovery.hottest + 1,
        "q_before_rad": recovery.q_before.tolist(),
        "q_after_rad": recovery.q_after.tolist(),
        "origin": recovery.origin,
        "most_moved_rad": float(np.abs(recovery.moved_rad).max()),
        "tool_moved_m": recovery.tool_m,
        "difficulty_before": recovery.difficulty_before.tolist(),
        "difficulty_after": recovery.difficulty_after.tolist(),
        "best_error": recovery.best_error,
        "passed_over": recovery.passed_over,
        "start_c": float(recovery.with_c[0, recovery.hottest]),
        "end_with_c": float(recovery.with_c[-1, recovery.hottest]),
        "end_without_c": float(recovery.without_c[-1, recovery.hottest]),
        "cooled_k": recovery.cooled_k,
        "spared_k": recovery.spared_k,
        "tracking_error_rad": recovery.error_rad,
    }


def _write(table: pa.Table, path: Path) -> None:
    if path.suffix == ".csv":
        pc.write_csv(table, path)
    else:
        pq.write_table(table, path)


def _write_card(card: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")
