"""A log that grows gives the windows of the finished log; what happens to the file meanwhile is named."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

from fleet.errors import LogError
from scenarios.show.twin_scores import score_windows, window_rows
from tests.commands import start
from tests.logs import csv_of
from twin.log_windows import WindowFeed
from twin.logs.reader import Damaged, GrowingLog, read
from twin.logs.recording import Recording
from twin.vae.twin import save


def log_of(motion, *, rate_hz: float = 10.0, jitter: float = 0.2, seconds: float = 30.0) -> Recording:
    """Smooth motion with a jittering clock and a gap of 5 s, in which joint 1 turns over and over."""
    rng = np.random.default_rng(4)
    q, qd, tau = motion(rng, seconds).astype(float)[:: round(50 / rate_hz)].swapaxes(0, 1)
    time_s = (np.arange(len(q)) + jitter * rng.uniform(-0.5, 0.5, len(q))) / rate_hz
    q[:, 0], qd[:, 0] = (0.9 * time_s + np.pi) % (2 * np.pi) - np.pi, 0.9
    time_s[len(q) // 2 :] += 5.0
    return Recording(name="grows", time_s=time_s, q=q, qd=qd, tau=tau, temp_c=30.0 + np.abs(q))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 25.0])
def test_a_growing_log_has_the_windows_of_the_finished_one(twin, motion, tmp_path, rate_hz):
    log = log_of(motion, rate_hz=rate_hz)
    text, path, rng = csv_of(log).encode(), tmp_path / "grows.csv", np.random.default_rng(0)
    path.touch()
    feed, rows = WindowFeed(twin), []
    with path.open("ab") as out, GrowingLog(path, first_s=0.96) as growing:
        for part in np.split(np.frombuffer(text, np.uint8), np.sort(rng.integers(0, len(text), 60))):
            out.write(part.tobytes())
            out.flush()
            while (recording := growing.read(feed.due_s)) is not None:
                rows += score_windows(twin, feed.add(recording))
    whole = window_rows(twin, read(path)[0])
    assert len(whole) - 2 <= len(rows) <= len(whole)
    by_start = {f"{row['start_s']:.6f}": row for row in whole}
    for row in rows:
        same = by_start[f"{row['start_s']:.6f}"]
        for name in ("d", "d_2", "load", "hottest_c", "end_s"):
            assert row[name] == pytest.approx(same[name], rel=1e-3, abs=1e-4), name


def test_a_slow_log_has_no_windows_and_readings_after_gaps_begin_anew(twin, recording_of):
    log = recording_of(4.0)
    slow = replace(log, time_s=4.0 * np.arange(len(log.time_s)))
    feed = WindowFeed(twin)
    assert [part for i in range(len(slow.time_s)) for part in feed.add(slow.part(slice(i, i + 1)))] == []
    parts = feed.add(replace(log, time_s=log.time_s + 5000.0))
    assert [stretch.time_s[0] for stretch, _, _ in parts] == [pytest.approx(5000.0, abs=0.1)]


def test_windows_may_overlap(twin, recording_of):
    feed, log = WindowFeed(twin, every_s=0.08), recording_of(4.0)
    parts = [part for i in range(len(log.time_s)) for part in feed.add(log.part(slice(i, i + 1)))]
    starts_s = np.concatenate([stretch.time_s[first] for stretch, first, _ in parts])
    np.testing.assert_allclose(np.diff(starts_s), 0.08, atol=1e-6)
    assert starts_s[-1] >= 3.98 - 0.96 - 2 * 0.08


def test_what_happens_to_a_followed_file_is_named(motion, tmp_path):
    log = log_of(motion, seconds=4.0)
    lines = csv_of(log).splitlines(keepends=True)

    def after(damage, *, damaged: Damaged = "refuse"):
        path = tmp_path / "grows.csv"
        path.unlink(missing_ok=True)
        path.write_text("".join(lines[:20]))
        with GrowingLog(path, damaged=damaged) as growing:
            first = growing.read(-np.inf)
            assert first is not None
            damage(path)
            return first, growing.read(first.time_s[-1] + 0.05)

    def append(text):
        return lambda path: path.write_text("".join(lines[:20]) + text)

    def replaced(path):
        path.with_suffix(".new").write_text("".join(lines[:30]))
        os.replace(path.with_suffix(".new"), path)

    for damage, words in (
        (append("1,2,oops\n"), r"grows\.csv, line 21: 3 fields where the header has 29"),
        (append(lines[3]), "line 21: time runs backwards"),
        (lambda path: path.write_text(lines[0]), "was truncated while it was followed"),
        (replaced, "was replaced by another file while it was followed"),
        (lambda path: path.unlink(), "was removed while it was followed"),
    ):
        with pytest.raises(LogError, match=words):
            after(damage)
    with pytest.raises(LogError, match="time starts again"):
        after(append("".join(lines[1:15])), damaged="skip")
    first, more = after(append("1,2,oops\n" + "".join(lines[20:24])), damaged="skip")
    assert more is not None
    np.testing.assert_allclose([*first.time_s, *more.time_s], log.time_s[:23])
    first, more = after(append(lines[20][:40]))  # the logger is in the middle of this line
    assert more is None
    with pytest.raises(LogError, match=r"only a file that ends in \.csv"):
        GrowingLog(tmp_path / "telemetry.parquet")


def test_what_is_dropped_from_a_growing_log_is_said_once(motion, tmp_path, caplog):
    head, *lines = csv_of(log_of(motion, seconds=4.0)).splitlines(keepends=True)
    path = tmp_path / "grows.csv"
    path.write_text(f"note,{head}")
    with GrowingLog(path, damaged="skip") as growing:
        for damage, line in zip(
            ("", "1,2,oops\n", "3,4\n", "5,0,x,0\n" + "5,0,x" + ",0" * 27 + "\n"), lines, strict=False
        ):
            with path.open("a") as out:
                out.write(f"7,{line}{damage}")
            growing.read(-np.inf)
    assert [record.message.partition(" dropped: ")[2] for record in caplog.records] == [
        "its columns note are unknown to a plain log (said once)",
        "line 4: 3 fields where the header has 30 (said once)",
        "line 9: field 3, 'x', is not a number (said once)",
    ]


def test_the_command_prints_a_line_per_window_until_ctrl_c(twin, motion, tmp_path):
    save(twin, tmp_path / "twin")
    path, lines = tmp_path / "grows.csv", csv_of(log_of(motion)).splitlines(keepends=True)
    path.write_text("".join(lines[:30]))
    with start("twin", "score", tmp_path / "twin", "--log", path, "--follow", "--format", "csv") as process:
        assert process.stdout is not None
        head, first = process.stdout.readline(), process.stdout.readline()
        assert head.startswith("log,start_s,end_s,d,d_1")
        with path.open("a") as out:
            out.write("".join(lines[30:60]))
        second = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "windows of 0.96 s" in said
    begin = head.split(",").index("start_s")
    assert float(second.split(",")[begin]) == pytest.approx(float(first.split(",")[begin]) + 0.96, abs=1e-4)
