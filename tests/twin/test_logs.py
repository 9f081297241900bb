"""Logs: three formats say the same motion, faults are told with their line, and any rate gives the same motion."""

import gzip
import logging
import os
import zlib
from collections.abc import Callable, Iterable
from itertools import combinations, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fleet.arm.model import ArmModel
from fleet.errors import LogError
from fleet.robot import Robot
from fleet.telemetry import Telemetry
from scenarios.run.log import telemetry_table
from twin.logs.reader import read, read_folder, time_damage
from twin.logs.recording import CONTINUOUS, READINGS, Recording, at_rate, interval_current_sq, interval_speed, stretches

LOGS = Path(__file__).parents[2] / "../shared/data/gen3_logs"


GEN3 = ["Time (s)", *(f"{g}_{j}" for g in ("Pos", "Temp", "Torque", "Current", "Velocity") for j in range(7))]
PLAIN = ["time_s", *(f"{c}_{j}" for c in READINGS for j in range(1, 8))]
TIME_S = (0.0, 0.5, 1.1, 1.5)


def gen3_row(time_s: float) -> list[str]:
    """Joint k (1..7) at k degrees below zero, 20 + k °C, k/10 N·m on the joint with some noise, −k/10 A, k/100 °/s."""
    k = np.arange(1, 8)
    numbers = [time_s, *(360.0 - k), *(20.0 + k), *((0.1 + 1e-9 * time_s) * k), *(-0.1 * k), *(0.01 * k)]
    return [repr(float(n)) for n in numbers]


def plain_row(time_s: float) -> list[str]:
    """The same in SI with our signs."""
    k = np.arange(1, 8)
    numbers = [time_s, *np.deg2rad(-k), *np.deg2rad(0.01 * k), *(-0.1 * k), *(-0.1 * k), *(20.0 + k)]
    return [repr(float(n)) for n in numbers]


def text(header: list[str], rows: Iterable[list[str]], end: str = "\r\n") -> str:
    return "".join(",".join(row) + end for row in (header, *rows))


@pytest.fixture
def gen3(tmp_path: Path) -> Callable[..., Path]:
    """Writes a Gen3 log in which single cells are other than they should be."""

    def write(cells: dict[tuple[int, str], str] | None = None, name: str = "log.csv", count: int = 4) -> Path:
        rows = [gen3_row(TIME_S[i] if i < 4 else i) for i in range(count)]
        for (line, column), cell in (cells or {}).items():
            rows[line - 2][GEN3.index(column)] = cell
        path = tmp_path / name
        path.write_bytes(text(GEN3, rows).encode())
        return path

    return write


def refused(path: Path, match: str, line: int | None) -> LogError:
    with pytest.raises(LogError, match=match) as caught:
        read(path)
    assert (caught.value.file, caught.value.line) == (str(path), line)
    return caught.value


def test_all_formats_say_the_same_in_si(tmp_path: Path, gen3: Callable[..., Path]):
    plain = tmp_path / "plain.csv"
    plain.write_text(text(PLAIN, map(plain_row, TIME_S), "\n"))
    packed = tmp_path / "packed.csv.gz"
    packed.write_bytes(gzip.compress(gen3().read_bytes()))
    k = np.tile(np.arange(1.0, 8.0), (4, 1))
    for path, name in ((gen3(), "log"), (plain, "plain"), (packed, "packed")):
        (recording,) = read(path)
        assert (recording.name, recording.dropped) == (name, ())
        np.testing.assert_allclose(recording.time_s, TIME_S)
        expected = {
            "q": np.deg2rad(-k),
            "qd": np.deg2rad(k / 100),
            "tau": -k / 10,
            "current_a": -k / 10,
            "temp_c": 20 + k,
        }
        for channel, values in expected.items():
            np.testing.assert_allclose(getattr(recording, channel), values, atol=1e-12)


def test_a_run_gives_a_recording_per_arm(tmp_path: Path):
    rng = np.random.default_rng(0)
    numbers = {c: rng.uniform(20, 30, (5, 2, 7)) if c == "temp_c" else rng.uniform(-2, 2, (5, 2, 7)) for c in READINGS}
    telemetry = Telemetry(time_s=np.arange(5.0), mode=np.zeros((5, 2), dtype=int), **numbers)
    pq.write_table(telemetry_table(telemetry, ["left", "right"]), tmp_path / "telemetry.parquet")
    pq.write_table(pa.table({"kind": ["fault"]}), tmp_path / "events.parquet")
    for recordings in (read(tmp_path / "telemetry.parquet"), read_folder(tmp_path)):
        assert [r.name for r in recordings] == [f"{tmp_path.name}/telemetry/{arm}" for arm in ("left", "right")]
        for channel in READINGS:
            np.testing.assert_allclose(getattr(recordings[1], channel), numbers[channel][:, 1].astype(np.float32))


def test_columns_may_come_in_any_order_and_currents_and_temperatures_may_lack(tmp_path: Path):
    order = np.random.default_rng(0).permutation(22)
    rows = [[row[i] for i in order] for row in map(plain_row, TIME_S)]
    path = tmp_path / "short.csv"
    path.write_text("\ufeff" + text([f'"{PLAIN[i]}"' for i in order], rows, "\n"), encoding="utf-8")
    (recording,) = read(path)
    np.testing.assert_allclose(recording.tau[0], -np.arange(1.0, 8.0) / 10)
    assert recording.current_a is recording.temp_c is None


@pytest.mark.parametrize(
    ("cells", "line", "match"),
    [
        ({(3, "Pos_1"): "abc"}, 3, "field 3, 'abc', is not a number"),
        ({(4, "Temp_0"): ""}, 4, "field 9, '', is not a number"),
        ({(4, "Temp_0"): "nan"}, 4, "field 9 is nan"),
        ({(2, "Torque_6"): "inf"}, 2, "field 22 is inf"),
        ({(3, "Velocity_6"): "1.0,2.0"}, 3, "37 fields where the header has 36"),
        ({(4, "Time (s)"): "0.2"}, 4, "time runs backwards: 0.2 s beside 0.5 s"),
        ({(4, "Time (s)"): "0.5"}, 4, "time repeats: 0.5 s"),
        ({(3, "Time (s)"): "900"}, 3, "time jumps ahead: 900 s"),
    ],
)
def test_a_damaged_line_is_named_and_the_rest_read_on_demand(gen3, cells, line, match, caplog):
    path = gen3(cells)
    assert 'Use damaged="skip"' in str(refused(path, match, line))
    with caplog.at_level(logging.WARNING):
        (recording,) = read(path, damaged="skip")
    keep = [i for i in range(4) if i != line - 2]
    np.testing.assert_allclose(recording.time_s, np.array(TIME_S)[keep])
    assert len(recording.dropped) == 1
    assert recording.dropped[0].startswith(f"line {line}: ")
    assert recording.dropped[0] in caplog.text


def test_an_end_in_the_middle_of_a_line_is_no_whole_line(gen3):
    whole = gen3().read_bytes()
    path = gen3()
    for kept in range(whole.rindex(b"\r\n", 0, -2) + 5, len(whole) - 1, 40):
        path.write_bytes(whole[:kept])
        refused(path, "ends in the middle of this line", 5)
        (recording,) = read(path, damaged="skip")
        assert recording.time_s.tolist() == list(TIME_S[:3])


def test_many_damaged_lines_are_told_shortly(gen3):
    cells = {(line, "Pos_0"): "x" for line in (*range(5, 15), 20)}
    path = gen3(cells, count=30)
    assert "and 10 more damaged places. Use damaged" in str(refused(path, "field 2, 'x'", 5))
    (recording,) = read(path, damaged="skip")
    assert [sentence.partition(":")[0] for sentence in recording.dropped] == ["lines 5 to 14", "line 20"]
    assert len(recording.time_s) == 19
    every_other = gen3({(line, "Pos_0"): "x" for line in range(5, 105, 2)}, count=110)
    assert read(every_other, damaged="skip")[0].dropped[-1] == "and 30 more damaged places"


def test_a_clock_set_anew_is_two_recordings(tmp_path: Path):
    path = tmp_path / "twice.csv"
    path.write_text(text(GEN3, [gen3_row(t) for t in (*range(10), *range(8))]))
    for damaged in ("refuse", "skip"):
        with pytest.raises(LogError, match=r"again at line 12 .9 s, then 0 s.: the file holds several recordings"):
            read(path, damaged=damaged)


@given(st.lists(st.integers(0, 30), min_size=1, max_size=10))
def test_as_many_samples_stay_as_can(times):
    # Second method: the longest strictly increasing subsequence by trying all of them.
    best = max(
        count
        for count in range(1, len(times) + 1)
        for chosen in combinations(times, count)
        if all(a < b for a, b in pairwise(chosen))
    )
    try:
        left_out = [damage.line for damage in time_damage(np.array(times, float), np.arange(len(times)))]
    except ValueError:
        assert len(times) - best > 3
        return
    kept = np.delete(np.array(times), left_out)
    assert (np.diff(kept) > 0).all()
    assert len(kept) == best


@pytest.mark.parametrize(
    ("content", "line", "match"),
    [
        (b"", None, "is empty"),
        (b"\r\n \n", None, "is empty"),
        (b"BZh91AY&SY", None, "is compressed, and not with gzip. Unpack it"),
        (text(GEN3, []).encode(), None, "holds no good line"),
        (b"a,b\r\n1,2\r\n", 1, "begins with 'a,b', where a Gen3 log has 'Time .s.' and a plain one 'time_s'"),
        (text(GEN3, []).replace(",", ";").encode(), 1, "separated by commas"),
        (text(GEN3[:-2], []).encode(), 1, "lacks the columns Velocity_5, Velocity_6 of a Gen3 log"),
        (text(GEN3[:-1], []).encode(), 1, "lacks the column Velocity_6 of a Gen3 log"),
        (text([n for n in GEN3 if not n.endswith("_6")], []).encode(), 1, "has 6 joints; only logs of a Gen3"),
        (text([n for n in PLAIN if n != "temp_c_3"], []).encode(), 1, "lacks the column temp_c_3 of a plain log"),
        (text([*PLAIN[:15], *(f"torque_{j}" for j in range(1, 8))], []).encode(), 1, "lacks the columns tau_1, tau_2"),
        (text([*GEN3, "Pos_0"], []).encode(), 1, "names the column 'Pos_0' twice"),
        (text(GEN3, map(gen3_row, TIME_S)).encode("utf-16-le"), 1, "holds NUL bytes; is it UTF-16"),
        (text(GEN3, map(gen3_row, TIME_S)).encode("latin-1").replace(b"T", b"\xb5"), 1, "begins with 'µime"),
    ],
)
def test_a_file_that_is_no_log_says_why(tmp_path: Path, content: bytes, line: int | None, match: str):
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    where = f"{path}, line {line}: " if line else f"{path}: "
    assert str(refused(path, match, line)).startswith(where)


def test_strange_columns_are_left_out_on_demand(tmp_path: Path):
    path = tmp_path / "more.csv"
    path.write_text(text([*GEN3, "Note"], [[*gen3_row(t), "1"] for t in TIME_S]))
    refused(path, "columns Note are unknown to a Gen3 log", None)
    (recording,) = read(path, damaged="skip")
    assert "Note" in recording.dropped[0]
    np.testing.assert_allclose(recording.time_s, TIME_S)


def test_a_broken_gzip_gives_what_it_holds_on_demand(tmp_path: Path, gen3):
    whole = gen3(count=200).read_bytes()
    packed = gzip.compress(whole, compresslevel=0)
    path = tmp_path / "half.csv.gz"
    path.write_bytes(packed[: len(packed) // 2])
    refused(path, "gzip data are cut off", None)
    (recording,) = read(path, damaged="skip")
    assert 80 <= len(recording.time_s) <= 100
    np.testing.assert_array_equal(recording.temp_c, read(gen3(count=200))[0].part(slice(len(recording.time_s))).temp_c)
    assert "cut off" in recording.dropped[0]
    assert "in the middle of this line" in recording.dropped[1]
    path.write_bytes(packed[:-8] + b"\0" * 8)
    refused(path, "gzip data are damaged: CRC", None)
    assert len(read(path, damaged="skip")[0].time_s) == 200
    path.write_bytes(b"<html>")
    refused(path, "holds no gzip data", None)
    path.write_bytes(zlib.compress(b"", wbits=31))
    refused(path, "is empty", None)


def test_a_line_in_another_encoding_is_a_damaged_line(gen3):
    path = gen3()
    path.write_bytes(path.read_bytes().replace(b"1.1,", b"1\xb71,"))
    refused(path, "field 1, '1·1', is not a number", 4)
    assert read(path, damaged="skip")[0].time_s.tolist() == [0.0, 0.5, 1.5]


def test_a_table_that_is_no_telemetry_says_why(tmp_path: Path):
    path = tmp_path / "telemetry.parquet"
    refused(path, "cannot be read: No such file or directory.", None)
    path.write_bytes(b"PAR1 and no more")
    refused(path, "is not a complete parquet file", None)
    columns = {"time_s": [0.0, 1.0, 2.0], **{name: [0.5] * 3 for name in PLAIN[1:]}}
    good = {"arm": ["a"] * 3, **columns}
    for table, words, line in (
        (columns, "lacks the column arm of a telemetry.parquet. Save the log of a real arm as CSV", None),
        (good | {"tick": [1, 2, 3]}, "is part of the recording of a fleet.*`thermofleet bus replay`", None),
        (good | {"q_3": ["x"] * 3}, "column q_3 holds string, not numbers", None),
        ({name: values for name, values in good.items() if name != "q_3"}, "lacks the column q_3", None),
        ({name: values for name, values in good.items() if name != "time_s"}, "lacks the column time_s", None),
        ({"arm": ["a"]}, "lacks the column time_s", None),
        (good | {"arm": ["a", None, "a"]}, "names no arm", 2),
        ({"arm": pa.array([], pa.string()), "time_s": pa.array([], pa.float64())}, "holds no rows", None),
        (good | {"tau_2": [0.0, None, 0.0]}, "tau_2 is missing or not a finite number", 2),
    ):
        pq.write_table(pa.table(table), path)
        refused(path, words, line)
    assert read(path, damaged="skip")[0].time_s.tolist() == [0.0, 2.0]
    with pytest.raises(ValueError, match="one of refuse, skip"):
        read(path, damaged="ignore")  # pyright: ignore[reportArgumentType]
    with pytest.raises(LogError, match="cannot be read: No such file"):
        read(tmp_path / "none.csv")
    with pytest.raises(LogError, match="is a folder"):
        read(tmp_path)


def test_a_folder_is_read_whole_or_says_what_is_left_out(tmp_path: Path, gen3, caplog):
    with pytest.raises(LogError, match=r"holds no log; a log ends in .csv.gz, .csv, .parquet"):
        read_folder(tmp_path)
    gen3({(2, "Temp_0"): "22"}, name="b.csv", count=3)
    gen3(name="a.csv")
    gen3({(2, "Temp_0"): "hot"}, name=".a.csv")
    (tmp_path / "notes.txt").write_text("kept apart")
    (tmp_path / "a.csv.1").write_text("rotated")
    assert [r.name for r in read_folder(tmp_path)] == ["a", "b"]
    assert "not read, as a log ends in .csv.gz, .csv, .parquet: a.csv.1" in caplog.text
    (tmp_path / "c.csv").write_text("no log\n")
    with pytest.raises(LogError, match=r"c\.csv, line 1: is not a log"):
        read_folder(tmp_path)
    with caplog.at_level(logging.WARNING):
        assert [r.name for r in read_folder(tmp_path, damaged="skip")] == ["a", "b"]
    assert "skipped" in caplog.text
    assert "c.csv" in caplog.text
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress((tmp_path / "a.csv").read_bytes()))
    with pytest.raises(LogError, match=r"'a.csv' and 'a.csv.gz' are the same log"):
        read_folder(tmp_path)
    with pytest.raises(LogError, match="does not exist"):
        read_folder(tmp_path / "none")
    with pytest.raises(LogError, match="is not a folder"):
        read_folder(tmp_path / "a.csv")


def test_a_log_counts_once_and_a_pipe_is_no_log(tmp_path: Path, gen3, caplog):
    gen3(name="a.csv")
    copy = tmp_path / "copy of a.csv.gz"
    copy.write_bytes(gzip.compress((tmp_path / "a.csv").read_bytes()))
    with pytest.raises(LogError, match=r"copy of a\.csv\.gz: has the readings of 'a\.csv', which would count twice"):
        read_folder(tmp_path)
    assert [r.name for r in read_folder(tmp_path, damaged="skip")] == ["a"]
    copy.unlink()
    (tmp_path / "a.csv").write_text("no log\n")
    with pytest.raises(LogError, match="none of its 1 logs is usable"):
        read_folder(tmp_path, damaged="skip")
    gen3(name="a.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(LogError, match=r"pipe\.csv: is a pipe or a device"):
        read_folder(tmp_path)
    (tmp_path / "sheet").write_bytes(b"PK\x03\x04...")
    refused(tmp_path / "sheet", "is a ZIP archive or an XLSX workbook", None)


def test_the_recorder_in_the_documentation_writes_a_gen3_log(tmp_path: Path):
    page = (Path(__file__).parents[2] / "docs/logs.md").read_text(encoding="utf-8")
    code = next(block for block in page.split("```python")[1:] if "def record" in block).partition("```")[0]
    space: dict[str, Any] = {}
    exec(code, space)
    k = iter(range(1, 8))
    actuators = [
        SimpleNamespace(
            position=360.0 - i, temperature_motor=20.0 + i, torque=0.1 * i, current_motor=-0.1 * i, velocity=i
        )
        for i in k
    ]
    arm = SimpleNamespace(RefreshFeedback=lambda: SimpleNamespace(actuators=actuators))
    space["record"](arm, tmp_path / "own.csv", duration_s=0.01, rate_hz=1e6)
    (own,) = read(tmp_path / "own.csv")
    np.testing.assert_allclose(own.q[0], np.deg2rad(-np.arange(1.0, 8.0)))
    np.testing.assert_allclose(own.tau[0], -np.arange(1.0, 8.0) / 10)
    np.testing.assert_allclose(own.temp_c[-1], 20 + np.arange(1.0, 8.0))


needs_logs = pytest.mark.skipif(not LOGS.is_dir(), reason="the Gen3 logs are not beside this checkout")


@needs_logs
def test_signs_of_a_real_arm_are_those_of_the_model():
    # Joint 2 held outstretched with a gripper of 0.75 kg: MuJoCo's gravity torque is the second method.
    (log,) = read(next(LOGS.glob("0_KinovaLog_joint_1.csv*")))
    some = log.part(slice(None, None, 40))
    model = ArmModel(Robot(name="logged"))
    gravity = np.array([model.gravity_torque(q, 0.75) for q in some.q])
    for joint in (1, 3, 5):
        assert np.polyfit(gravity[:, joint], some.tau[:, joint], 1)[0] == pytest.approx(1.0, abs=0.2)
        assert np.corrcoef(some.current_a[:, joint], some.tau[:, joint])[0, 1] > 0.9
    # A circle is slow enough for two samples a second: there the velocities are those of the positions.
    (circle,) = read(next(LOGS.glob("1_KinovaLog_circle.csv*")))
    np.testing.assert_allclose(
        np.polyfit(np.gradient(circle.q[:, 1], circle.time_s), circle.qd[:, 1], 1)[0], 1, atol=0.1
    )


def recording(time_s: list[float], joints: int = 7, **channels: np.ndarray) -> Recording:
    still = np.zeros((len(time_s), joints))
    return Recording(name="a", time_s=np.array(time_s), **{"q": still, "qd": still, "tau": still, **channels})


@pytest.mark.parametrize("channel", READINGS)
def test_channels_must_fit_the_time_and_be_finite(channel: str):
    with pytest.raises(ValueError, match=r"\(2, 7\)" if channel != "q" else "must be"):
        recording([0.0, 1.0], **{channel: np.zeros((3, 7))})
    hole = np.zeros((2, 7))
    hole[1, 4] = np.nan
    with pytest.raises(ValueError, match=f"{channel} of joint 5 is not finite"):
        recording([0.0, 1.0], **{channel: hole})


@pytest.mark.parametrize(
    ("times", "channels", "words"),
    [
        ([0.0, 1.0, 1.0], {}, "from 1.0 s to 1.0 s"),
        ([0.0, 2.0, 1.0], {}, "from 2.0 s to 1.0 s"),
        ([0.0, np.inf], {}, "time_s is not finite"),
        ([0.0], {"tau": np.zeros((1, 6))}, "tau must be"),
        ([0.0], {"q": np.zeros(7)}, r"q \[time, joint\]"),
    ],
)
def test_time_must_grow_and_joints_agree(times: list[float], channels: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        recording(times, **channels)


def test_heat_follows_the_mean_square_of_the_current():
    amps = np.array([[1.0] * 7, [3.0] * 7])
    np.testing.assert_allclose(interval_current_sq(recording([0.0, 0.5], current_a=amps)), 5.0)
    with pytest.raises(ValueError, match="no motor currents"):
        interval_current_sq(recording([0.0, 0.5]))


def test_angles_wrap_and_short_moves_count():
    # Half a degree on either side of zero in half a second is 2°/s, by whatever turn it is written.
    q = np.deg2rad([[359.5] * 7, [0.5] * 7])
    np.testing.assert_allclose(interval_speed(recording([0.0, 0.5], q=q)), np.deg2rad(2.0))
    # There and back between two samples: positions see nothing, the velocities do.
    qd = np.array([[0.3] * 7, [-0.1] * 7])
    np.testing.assert_allclose(interval_speed(recording([0.0, 0.5], qd=qd)), 0.2)


JOINTS = 7
rates = st.floats(0.2, 60.0)
steps = st.lists(st.floats(0.02, 1.9), min_size=2, max_size=60)


def recorded(time_s: np.ndarray, q: np.ndarray, qd: np.ndarray | None = None, **channels: np.ndarray) -> Recording:
    """A recording of motion [time, joint] that is right up to the turns in which angles are written."""
    qd = np.gradient(q, time_s, axis=0) if qd is None else qd
    return Recording(name="a", time_s=time_s, q=q, qd=qd, tau=np.cos(q), **channels)


def times(steps_s: list[float]) -> np.ndarray:
    return 3.0 + np.concatenate([[0.0], np.cumsum(steps_s)])


@given(steps, rates, st.floats(-3, 3), st.floats(-1, 1))
def test_constants_and_ramps_are_kept_whatever_the_clocks(steps_s, rate_hz, level, slope):
    time_s = times(steps_s)
    moments, values = at_rate(time_s, np.stack([np.full_like(time_s, level), slope * time_s], axis=1), rate_hz)
    np.testing.assert_allclose(values, np.stack([np.full_like(moments, level), slope * moments], axis=1), atol=1e-9)
    np.testing.assert_allclose(np.diff(moments), 1 / rate_hz, rtol=1e-6)
    assert len(moments) >= np.floor((time_s[-1] - time_s[0]) * rate_hz)


@given(steps, st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_a_slower_clock_keeps_means(steps_s, seed, samples):
    time_s = times(steps_s)
    values = np.random.default_rng(seed).normal(size=len(time_s))
    whole_s = time_s[-1] - time_s[0]
    assume(np.median(steps_s) < whole_s / samples * 0.999)
    moments, means = at_rate(time_s, values, samples / whole_s)
    assert len(moments) == samples
    # Trapezoidal rule: the time mean of the polygon through the readings.
    np.testing.assert_allclose(means.mean(), np.trapezoid(values, time_s) / whole_s, atol=1e-9)


def test_the_same_clock_changes_nothing():
    time_s = 7.0 + np.arange(40) / 2.0
    values = np.random.default_rng(0).normal(size=(40, 3, JOINTS))
    moments, same = at_rate(time_s, values, 2.0)
    np.testing.assert_allclose(moments, time_s)
    np.testing.assert_allclose(same, values, atol=1e-9)


@given(st.lists(st.floats(0.02, 9.0), min_size=2, max_size=60), rates, st.floats(-1.3, 1.3), st.floats(-20, 20))
def test_a_wrap_never_shows(steps_s, rate_hz, speed, start):
    # At constant speed every joint that turns without end goes on straight, though its angle is written within a turn
    # and more than a whole turn may lie between two samples.
    time_s = times(steps_s)
    assume((time_s[-1] - time_s[0]) * rate_hz > 1)
    angle = start + speed * (time_s - time_s[0])
    q = np.zeros((len(time_s), JOINTS))
    q[:, CONTINUOUS] = ((angle + np.pi) % (2 * np.pi) - np.pi)[:, None]
    qd = np.zeros_like(q)
    qd[:, CONTINUOUS] = speed
    (stretch,) = stretches(recorded(time_s, q, qd), rate_hz, gap_s=9.5)
    found = stretch.profile[:, 0][:, CONTINUOUS]
    straight = found[0] + speed * (stretch.time_s - stretch.time_s[0])[:, None]
    np.testing.assert_allclose(found, straight, atol=1e-6)
    assert not stretch.profile[:, 0, 1].any()


def test_joints_with_stops_are_never_turned():
    # Sampled velocities may say anything at a slow rate; a joint that cannot turn past its stop did not.
    time_s = np.arange(4.0)
    q = np.tile(np.array([-2.0, 2.0, -2.0, 2.0])[:, None], JOINTS)
    (stretch,) = stretches(recorded(time_s, q, np.full_like(q, 6.0)), 1.0)
    np.testing.assert_allclose(stretch.profile[:, 0, [1, 3, 5]], q[:, [1, 3, 5]])


def test_a_gap_parts_and_a_lone_sample_is_left_out():
    time_s = np.array([0.0, 0.5, 1.0, 9.0, 20.0, 20.5, 21.5])
    q = np.tile(time_s[:, None], JOINTS) / 100
    temp_c = 30 + np.tile(time_s[:, None], JOINTS)
    first, second = stretches(recorded(time_s, q, temp_c=temp_c), 2.0)
    np.testing.assert_allclose(first.time_s, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(second.time_s, [20.0, 20.5, 21.0, 21.5])
    assert second.temp_c is not None
    np.testing.assert_allclose(second.temp_c, 30 + np.tile(second.time_s[:, None], JOINTS))
    assert (first.recording, first.profile.shape) == ("a", (3, 3, JOINTS))
    (whole,) = stretches(recorded(time_s, q), 2.0, gap_s=11.0)
    np.testing.assert_allclose(whole.profile[:, 0, 1], whole.time_s / 100)


def test_arguments_that_leave_nothing_are_refused():
    slow = recorded(np.arange(5.0) * 6.0, np.zeros((5, JOINTS)))
    with pytest.raises(ValueError, match="a sample every 6 s"):
        stretches(slow, 2.0)
    with pytest.raises(ValueError, match="rate_hz must be > 0"):
        stretches(slow, 0.0, gap_s=10.0)
    with pytest.raises(ValueError, match="gap_s must be > 0"):
        stretches(slow, 1.0, gap_s=0.0)
    assert stretches(slow.part(slice(0, 1)), 2.0) == []
    assert stretches(slow, 0.01, gap_s=10.0) == []
