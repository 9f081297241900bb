"""Arrivals of jobs against theory, and bounds of the numbers of a job, wherever they come from."""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from fleet.arrivals import Arrivals, arrival_table, sample_arrivals, scale_rate
from fleet.bus.protocol.auction import JobSpec, Submission
from fleet.bus.protocol.messages import decode
from fleet.bus.protocol.operator import check_request
from fleet.errors import FleetError
from fleet.jit import kernel
from fleet.job import Job, Place, Work
from fleet.robot import Mount
from fleet.seeding import key_of
from scenarios.live.requests import explain, read_jobs
from scenarios.spec.load import load
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import Scenario

HORIZON_S = 8 * 3600.0


@kernel
def sample(table, stream, key, out):
    """The inlined function as one that Python calls."""
    return sample_arrivals(table, stream, key, out)


def release_times(stream: Arrivals, horizon_s: float, seed: int = 0, room: int = 200_000) -> np.ndarray:
    """The arrivals of the second of three streams."""
    table = arrival_table([Arrivals(kind="batch", count=2), stream, Arrivals(kind="trace", times_s=(1.0,))], horizon_s)
    key, out = np.uint64(key_of(np.random.SeedSequence(seed))), np.full(room, np.nan)
    count = sample.chosen()(table, 1, key, out)
    assert np.isnan(out[count:]).all()
    if count:
        assert sample.chosen()(table, 1, key, out[: count - 1]) == -1  # no room
    return out[:count].copy()


def test_poisson_counts_have_the_mean_and_the_spread_of_theory() -> None:
    stream, shifts = Arrivals(kind="poisson", every_s=600.0), 4000
    counts = np.array([len(release_times(stream, HORIZON_S, s, room=200)) for s in range(shifts)])
    mean = HORIZON_S / 600.0
    # The mean of n counts has the deviation √(μ/n); their variance, μ √(2/n + 1/(μ n)). Four deviations each.
    assert counts.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / shifts))
    assert counts.var() == pytest.approx(mean, abs=4 * mean * np.sqrt(2 / shifts + 1 / (mean * shifts)))


def test_poisson_gaps_are_exponential_and_times_uniform() -> None:
    times = release_times(Arrivals(kind="poisson", every_s=10.0), 1e6, 5)
    gaps = np.diff(times, prepend=0.0)
    assert stats.kstest(gaps, "expon", args=(0, 10.0)).pvalue > 0.01
    assert stats.kstest(times, "uniform", args=(0, 1e6)).pvalue > 0.01


@given(
    every_s=st.floats(1.0, 1e4),
    start_s=st.floats(0.0, 5e4),
    length_s=st.floats(0.0, 5e4),
    horizon_s=st.floats(0.0, 5e4),
    seed=st.integers(0, 9),
)
def test_poisson_arrivals_are_in_order_and_inside(every_s, start_s, length_s, horizon_s, seed) -> None:
    stream = Arrivals(kind="poisson", every_s=every_s, start_s=start_s, stop_s=start_s + length_s)
    times = release_times(stream, horizon_s, seed)
    assert (np.diff(times) >= 0).all()
    assert ((times >= start_s) & (times <= min(start_s + length_s, horizon_s))).all()
    np.testing.assert_array_equal(times, release_times(stream, horizon_s, seed))


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (Arrivals(kind="batch", count=3), [0.0, 0.0, 0.0]),
        (Arrivals(kind="batch", count=2, start_s=10.0, every_s=40.0), [10.0, 10.0, 50.0, 50.0, 90.0, 90.0]),
        (Arrivals(kind="batch", count=1, start_s=100.0), []),
        (Arrivals(kind="batch", count=1, start_s=99.0), [99.0]),
        (Arrivals(kind="trace", times_s=(0.0, 3.0, 3.0, 99.5, 100.0, 250.0)), [0.0, 3.0, 3.0, 99.5]),
        (Arrivals(kind="poisson", every_s=5.0, start_s=300.0), []),
    ],
)
def test_arrivals_stop_before_the_horizon(stream, expected) -> None:
    assert release_times(stream, 100.0).tolist() == expected


def test_a_scaled_stream_arrives_more_often() -> None:
    stream, shifts = Arrivals(kind="poisson", every_s=600.0, start_s=10.0), 2000
    counts = [len(release_times(scale_rate(stream, 2.5), HORIZON_S, s, room=400)) for s in range(shifts)]
    mean = 2.5 * (HORIZON_S - 10.0) / 600.0
    assert np.mean(counts) == pytest.approx(mean, abs=4 * np.sqrt(mean / shifts))
    assert scale_rate(Arrivals(kind="batch", count=2, every_s=30.0), 3.0) == Arrivals(
        kind="batch", count=2, every_s=10.0
    )
    for fixed in (Arrivals(kind="batch", count=2), Arrivals(kind="trace", times_s=(1.0, 2.0))):
        assert scale_rate(fixed, 3.0) == fixed


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Arrivals(kind="poisson", every_s=0.0), r"Arrivals.every_s must be > 0 and finite \(got 0.0\)"),
        (lambda: Arrivals(kind="poisson", every_s=math.nan), "every_s must be > 0 and finite"),
        (lambda: Arrivals(kind="poisson", every_s=1.0, start_s=5.0, stop_s=4.0), "0 <= start_s <= stop_s"),
        (lambda: Arrivals(kind="poisson", every_s=1.0, start_s=-1.0), "0 <= start_s <= stop_s"),
        (lambda: Arrivals(kind="poisson", every_s=1.0, start_s=math.inf), "0 <= start_s <= stop_s"),
        (lambda: Arrivals(kind="batch", count=0), r"Arrivals.count must be >= 1 \(got 0\)"),
        (lambda: Arrivals(kind="batch", count=1, start_s=-1.0), "Arrivals.start_s must be >= 0"),
        (lambda: Arrivals(kind="batch", count=1, start_s=math.inf), "Arrivals.start_s must be >= 0"),
        (lambda: Arrivals(kind="batch", count=1, every_s=0.0), "Arrivals.every_s must be > 0"),
        (lambda: Arrivals(kind="batch", count=1, every_s=math.inf), "Arrivals.every_s must be > 0"),
        (lambda: Arrivals(kind="trace", times_s=(3.0, 2.0)), "in order"),
        (lambda: Arrivals(kind="trace", times_s=(-1.0,)), "in order"),
        (lambda: Arrivals(kind="trace", times_s=(math.nan,)), "must be|in order"),
    ],
)
def test_streams_that_cannot_be_are_refused(make, says) -> None:
    with pytest.raises(ValueError, match=says):
        make()


ALLOWED = {
    "payload_kg": (0, 10),
    "force_n": (0, 200),
    "dwell_s": (0.02, 3600),
    "repetitions": (1, 100_000),
    "release_s": (0, 1e9),
    "due_s": (0, 1e9),
    "value": (0, 1e6),
}

INTEGERS = st.one_of(
    st.integers(), st.integers(-(10**400), 10**400), st.integers(-3, 210), st.integers(99_990, 100_010)
)

NUMBERS = st.one_of(
    INTEGERS,
    st.floats(),
    st.floats(0, 4000),
    st.sampled_from([float(bound) for bounds in ALLOWED.values() for bound in bounds]),
)

HERE, THERE = Place(name="here", position_m=(0.4, 0.0, 0.3)), Place(name="there", position_m=(0.4, 0.2, 0.3))
HOLD = Work(kind="hold", places=(HERE,), dwell_s=1.0)


def check(field: str, value: float, make: Callable[[], object]) -> None:
    """Making it succeeds if the value is within its bounds, and otherwise names field, value and bounds."""
    low, high = ALLOWED[field]
    error = error_of(make)
    assert (error is None) == (low <= value <= high)
    if error is not None:
        assert field in error
        assert f"between {low:.15g} and {high:.15g}" in error
        assert f"got {value}" in error


def error_of(make: Callable[[], object]) -> str | None:
    """The text of the only errors that bad input may raise; None for none."""
    try:
        make()
    except (ValueError, FleetError) as error:
        return explain(error) if isinstance(error, msgspec.ValidationError) else str(error)
    return None


def with_stream(which: str, **fields: object) -> Scenario:
    """The scenario quickstart with fields of its first stream of a kind changed."""
    raw = msgspec.to_builtins(load("quickstart"))
    streams = [stream | fields if stream["kind"] == which else stream for stream in raw["jobs"]]
    return parse_scenario(raw | {"jobs": streams}, Path("quickstart.toml"))


@given(st.sampled_from(["payload_kg", "force_n", "dwell_s"]), NUMBERS)
def test_a_work_keeps_the_bounds(field, value):
    check(field, value, lambda: Work(kind="press", places=(HERE,), **{field: value}))


@given(
    st.one_of(st.tuples(st.sampled_from(["release_s", "value"]), NUMBERS), INTEGERS.map(lambda n: ("repetitions", n)))
)
def test_a_job_keeps_the_bounds(changed):
    field, value = changed
    fields = {"repetitions": 1, "release_s": 0.0, "value": 1.0} | {field: value}
    check(field, value, lambda: Job(name="j", work=HOLD, due_s=math.inf, **fields))


@given(st.sampled_from(list(ALLOWED)), NUMBERS)
def test_a_job_in_a_message_keeps_the_bounds(field, value):
    """A JSON number beyond the largest double is refused by the decoder, which knows the field but not the number."""
    assume(field != "repetitions" or isinstance(value, int))
    job = {"name": "j", "kind": "press", "places": ["here"], field: value}
    if -1e300 < value < 1e300:
        check(field, value if field == "repetitions" else float(value), partial(decoded, JobSpec, job))
        check(field, value if field == "repetitions" else float(value), partial(decoded, Submission, {"jobs": [job]}))
    else:
        assert error_of(partial(decoded, JobSpec, job)) is not None
        assert error_of(lambda: decode(Submission, json.dumps({"jobs": [job]}).encode())) is not None


def decoded(kind: type[msgspec.Struct], content: object) -> msgspec.Struct:
    return msgspec.json.decode(json.dumps(content), type=kind)


@given(st.sampled_from(["payload_kg", "force_n", "dwell_s", "value", "due_s"]), NUMBERS)
def test_a_scenario_keeps_the_bounds(field, value):
    content = [value] if field == "payload_kg" else value
    error = error_of(lambda: with_stream("press", repetitions=[1, 1], **{field: content}))
    low, high = ALLOWED[field]
    if field == "due_s":  # of the last job, which is released before the horizon
        high -= load("quickstart").horizon_s
    assert (error is None) == (low <= value <= high)
    assert error is None or field in error


def test_only_a_press_has_a_contact_force_wherever_the_job_comes_from(tmp_path):
    (tmp_path / "jobs.csv").write_text("name,kind,places,force\nj,hold,bench,10\n")
    job = JobSpec("j", "hold", ("here",), force_n=10.0)
    makers = (
        lambda: Work(kind="hold", places=(HERE,), force_n=10.0),
        lambda: check_request(Submission((job,))),
        lambda: with_stream("hold", force_n=10.0),
        lambda: read_jobs(str(tmp_path / "jobs.csv")),
    )
    for make in makers:
        assert "must be 0 or left out: only a press has a contact force (got 10 N for a hold)" in (error_of(make) or "")


def test_numbers_that_no_double_holds_name_their_bounds():
    job = json.dumps({"name": "j", "kind": "hold", "places": ["here"], "payload_kg": 10**400})
    error = error_of(lambda: msgspec.json.decode(job, type=JobSpec))
    assert error == "The number is too large; it must be between 0 and 10 kg (at payload_kg)."


def test_a_job_that_would_take_longer_than_a_week_is_refused():
    work = Work(kind="hold", places=(HERE,), dwell_s=3600.0)
    assert Job(name="j", work=work, repetitions=168, release_s=0.0, due_s=1.0, value=1.0)
    with pytest.raises(ValueError, match=r"at most 604800 s, 7 days \(got 169 times 3600 s\)"):
        Job(name="j", work=work, repetitions=169, release_s=0.0, due_s=1.0, value=1.0)
    with pytest.raises(ValueError, match="7 days"):
        JobSpec("j", "hold", ("here",), repetitions=100_000, dwell_s=60.0)


@pytest.mark.parametrize("kind", ["pick_place", "sort"])
def test_a_place_named_twice_is_refused(kind):
    assert Work(kind=kind, places=(HERE, THERE))
    with pytest.raises(ValueError, match=rf"two different places, from and to, for a {kind} \(got here, here\)"):
        Work(kind=kind, places=(HERE, HERE))
    with pytest.raises(ValueError, match="two different places"):
        JobSpec("j", kind, ("here", "here"))


def test_a_coordinate_in_millimetres_is_questioned():
    with pytest.raises(ValueError, match=r"Place\.position_m must be .* -10 and 10 m \(got 450.0, 0.0, 300.0\)"):
        Place(name="far", position_m=(450.0, 0.0, 300.0))
    with pytest.raises(ValueError, match="were millimetres meant"):
        Mount(position_m=(0.0, -620.0, 0.0))
