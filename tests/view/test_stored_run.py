"""A run read from its folder, and what a page gets of it."""

import base64
import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet.errors import FleetError
from fleet.telemetry import Telemetry
from scenarios.cli.main import main
from scenarios.run.log import open_run, telemetry_table
from scenarios.show.page import packed


def unpacked(text: str) -> dict[str, tuple[dict, np.ndarray]]:
    """Every array of a playback with its entry in the list, decoded as its docstring says."""
    raw = gzip.decompress(base64.b64decode(text))
    head, _, body = raw.partition(b"\n")
    out, at = {}, 0
    for entry in json.loads(head):
        count = int(np.prod(entry["shape"]))
        steps = np.frombuffer(body, "<i2", count, at).reshape(entry["shape"]).astype(np.int64)
        at += 2 * count
        out[entry["name"]] = entry, np.cumsum(steps, axis=-1).astype(np.int16) * entry["scale"]
    assert at == len(body)
    return out


def test_the_readings_are_those_of_the_file(run_folder: Path) -> None:
    run = open_run(run_folder)
    again = telemetry_table(run.readings, list(run.arms))
    assert again.drop_columns(["arm", "mode"]).equals(
        pq.read_table(run_folder / "telemetry.parquet").drop_columns(["arm", "mode"])
    )
    assert {job.job for job in run.jobs} >= {event.job for event in run.events if event.job}
    awards = [event for event in run.events if event.kind == "award"]
    assert len(run.offers) == len(awards) * len(run.arms)
    assert [(o.time_s, o.job, o.arm) for o in run.offers if o.awarded] == [(e.time_s, e.job, e.arm) for e in awards]


def test_a_page_gets_the_shift_within_its_resolution(run_folder: Path) -> None:
    readings = open_run(run_folder).readings
    arrays = unpacked(packed(readings))
    entry, q = arrays["q"]
    stride = round(entry["step_s"] / float(readings.time_s[1] - readings.time_s[0]))
    np.testing.assert_allclose(np.moveaxis(q, -1, 0), readings.q[::stride], atol=0.51e-3)
    entry, temp_c = arrays["temp_c"]
    stride = round(entry["step_s"] / float(readings.time_s[1] - readings.time_s[0]))
    np.testing.assert_allclose(np.moveaxis(temp_c, -1, 0), readings.temp_c[::stride], atol=0.051)


def test_an_absent_arm_keeps_its_last_posture() -> None:
    q = np.tile(np.arange(6.0)[:, None, None], (1, 2, 7))
    q[2:4, 1] = q[0, 0] = np.nan
    still = np.zeros_like(q)
    readings = Telemetry(np.arange(6.0), np.ones((6, 2), int), q, still, still, still, still)
    arrays = unpacked(packed(readings))
    np.testing.assert_allclose(arrays["q"][1][1, 0], [0, 1, 1, 1, 4, 5])
    np.testing.assert_allclose(arrays["q"][1][0, 0], [1, 1, 2, 3, 4, 5])
    assert arrays["mode"][1].tolist() == [[-1, 1, 1, 1, 1, 1], [1, 1, -1, -1, 1, 1]]


@pytest.mark.parametrize("damage", ["jobs.parquet", "telemetry.parquet", "run.json"])
def test_a_damaged_run_is_refused_in_words(run_folder: Path, tmp_path: Path, damage: str) -> None:
    copied = shutil.copytree(run_folder, tmp_path / "run")
    (copied / damage).write_bytes(b"PAR1 cut short")
    with pytest.raises(FleetError, match="no complete folder of `thermofleet run`"):
        open_run(copied)


def test_a_run_without_readings_or_with_events_of_another_fleet_is_refused(run_folder: Path, tmp_path: Path) -> None:
    telemetry, events = (pq.read_table(run_folder / f"{name}.parquet") for name in ("telemetry", "events"))
    ghosts = pa.array(["ghost"] * events.num_rows)
    damaged = {"telemetry": telemetry.slice(0, 0), "events": events.set_column(2, "arm", ghosts)}
    assert events.schema.names[2] == "arm"
    for name, table in damaged.items():
        copied = shutil.copytree(run_folder, tmp_path / name)
        pq.write_table(table, copied / f"{name}.parquet")
        with pytest.raises(FleetError, match="has no rows" if name == "telemetry" else "No arm 'ghost'"):
            open_run(copied)


def test_the_report_written_anew_is_the_same(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["report", str(run_folder), "--out", str(tmp_path / "again.html")])
    assert ended.value.code in (0, None)
    assert (tmp_path / "again.html").read_bytes() == (run_folder / "report.html").read_bytes()
