"""Smith's rule: the most value per time first, and for the careful one never what would run too warm."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agents.rules import Wspt, WsptCool
from fleet.observation import Layout, Observation
from tests.profiles import examples


def seen(value, duration_s, p, mask) -> dict[str, Observation]:
    arms, slots = np.shape(value)
    layout = Layout(arms, slots)
    blank = layout.read(np.zeros(layout.size, np.float32), np.zeros(slots + 2, np.int8))
    return {
        f"arm_{a}": replace(
            blank,
            value=np.array(value[a], dtype=float),
            duration_s=np.array(duration_s[a], dtype=float),
            p_saturation=np.array(p[a], dtype=float),
            action_mask=np.pad(mask[a], 1, constant_values=(1, 0)).astype(np.int8),
        )
        for a in range(arms)
    }


def test_value_per_time_decides_and_each_job_goes_once() -> None:
    everything = seen([[2, 3], [2, 3]], [[60, 300], [100, 100]], np.zeros((2, 2)), np.ones((2, 2)))
    assert Wspt().act(everything) == {"arm_0": 1, "arm_1": 2}


def test_the_careful_one_rests_where_it_would_run_warm() -> None:
    warm = seen([[9, 1]], [[60, 60]], [[0.51, 0.5]], [[1, 1]])
    assert Wspt().act(warm) == {"arm_0": 1}
    assert WsptCool().act(warm) == {"arm_0": 2}
    assert WsptCool().act(seen([[9]], [[60]], [[0.9]], [[1]])) == {"arm_0": 0}


@examples(60)
@given(data=st.data(), arms=st.integers(1, 3), slots=st.integers(1, 3))
def test_no_other_first_pair_is_worth_more(data, arms, slots) -> None:
    def draw(low, high):
        return np.array(data.draw(st.lists(st.integers(low, high), min_size=arms * slots, max_size=arms * slots)))

    value, duration_s = draw(1, 9).reshape(arms, slots), 30 * draw(1, 9).reshape(arms, slots)
    mask = draw(0, 1).reshape(arms, slots)
    actions = list(Wspt().act(seen(value, duration_s, np.zeros((arms, slots)), mask)).values())
    claimed = [(a, k - 1) for a, k in enumerate(actions) if k]
    assert all(mask[a, k] for a, k in claimed)
    assert len({k for _, k in claimed}) == len(claimed)
    rate = np.where(mask, value / duration_s, -1.0)
    if mask.any():
        assert max(rate[a, k] for a, k in claimed) == rate.max()
    waiting = [a for a in range(arms) if not actions[a]]
    left = [k for k in range(slots) if k not in {k for _, k in claimed}]
    assert not mask[np.ix_(waiting, left)].any()  # nothing is left lying that a waiting arm could do
