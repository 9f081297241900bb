"""Tables of several policies: pairs, Holm's correction over all differences, and cells without variation."""

import numpy as np
import pytest

from scenarios.evaluate.statistics import EQUAL, FigureKind, figure_rows, figures_of, holm, interval, paired, remarks


@pytest.fixture
def values() -> dict[str, dict[str, np.ndarray]]:
    """Ten seeds: `better` clearly, `luck` at p = .02 by itself, `same` by a constant."""
    rng = np.random.default_rng(0)
    jobs, noise = rng.normal(100.0, 30.0, 10), rng.normal(0.0, 1.0, 10)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    value = {"base": jobs, "better": jobs + 8.0 + noise, "luck": jobs + 1.1 + noise, "same": jobs + 2.0}
    return {policy: {"value": each, "faults": np.zeros(10)} for policy, each in value.items()}


def test_differences_are_paired_and_corrected_over_the_table(values):
    found = figures_of(values, "base", {"faults": FigureKind("faults", is_count=True)})
    better, luck = found["better"]["value"], found["luck"]["value"]
    expected = paired(values["better"]["value"], values["base"]["value"])
    assert (better.difference, better.difference_low) == (expected.mean, expected.low)
    assert better.low == interval(values["better"]["value"]).low
    assert better.difference_high - better.difference_low < 0.1 * (better.high - better.low)
    # Tests: two of value, three of faults (without an event, p = 1); `same` has no variation, so no test.
    raw = [found[policy][name].p for policy in ("better", "luck", "same") for name in ("value", "faults")]
    assert np.isfinite(raw).sum() == 5
    assert better.p_holm == 5 * better.p == pytest.approx(np.nanmin(holm(raw)))
    assert (better.stars, luck.stars) == ("**", "*")
    assert luck.p < 0.05 < luck.p_holm


def test_a_policy_differs_from_itself_by_nothing_and_two_without_faults_by_a_bound(values):
    found = figures_of(values, "base", {"faults": FigureKind("faults", is_count=True)})
    base, other = found["base"]["faults"], found["better"]["faults"]
    assert (base.difference_low, base.difference_high) == (0.0, 0.0)
    assert (other.low, other.high) == (0.0, pytest.approx(0.369, abs=0.001))
    assert (other.difference_low, other.difference_high) == (-other.high, other.high)


def test_cells_without_variation_say_so(values):
    found = figures_of(values, "base", {"faults": FigureKind("faults", is_count=True)})
    shown = figure_rows({policy: each["value"] for policy, each in found.items()}, "base", str)
    rows = {name: cells for name, *cells in shown}
    assert rows["same"][-3:] == ["+2.0", EQUAL, ""]
    assert rows["better"][-1] == "**"
    assert list(remarks(found, 10)) == [
        "all equal: no variation in 10, which is not certainty; up to 31% of all may differ.",
        "Counts without an event have the exact bound of a Poisson mean.",
    ]
