"""Laying out what is known: which of two ages counts, and what nobody said."""

import numpy as np

from fleet.bus.exchange.protocol import UNHEARD, Condition, Scores, assemble


def test_age_is_that_of_the_older_of_the_two_words():
    conditions = [
        [Condition(100.0, "working", 5.0, 60.0), Condition(90.0, "idle", 6.0, 0.0)],
        [Condition(60.0, "faulted", 7.0, 0.0), None],
    ]
    scores = [[Scores(70.0, ("j",), [0.5], [0.1]), Scores(95.0, ("j",), [0.6], [0.2])], [None, None]]
    heard = assemble(100.0, ("j",), conditions, scores)
    np.testing.assert_array_equal(heard.age_s, [[30.0, 10.0], [np.inf, np.inf]])
    np.testing.assert_array_equal(heard.mode, [[1, 0], [2, UNHEARD]])
    np.testing.assert_array_equal(heard.headroom_k, [[5.0, 6.0], [7.0, np.nan]])
    np.testing.assert_array_equal(heard.busy_s, [[60.0, 0.0], [0.0, np.nan]])
    np.testing.assert_array_equal(heard.difficulty[..., 0], [[0.5, 0.6], [np.nan, np.nan]])
    np.testing.assert_array_equal(heard.p_saturation[..., 0], [[0.1, 0.2], [np.nan, np.nan]])


def test_scores_go_to_the_slot_of_their_job():
    said = Scores(0.0, ("a", "b", "c"), [1.0, 2.0, 3.0], [0.1, 0.2, 0.3])
    heard = assemble(0.0, ("c", "", "x", "a"), [[Condition(0.0, "idle", 0.0, 0.0)]], [[said]])
    np.testing.assert_array_equal(heard.difficulty[0, 0], [3.0, np.nan, np.nan, 1.0])
    np.testing.assert_array_equal(heard.p_saturation[0, 0], [0.3, np.nan, np.nan, 0.1])
