"""What the test of every trainer checks; its file imports these tests, and has `trained` and a fixture `session`."""

from typing import Any

import numpy as np

Parameters = dict[str, np.ndarray]


def parameters(module: Any) -> Parameters:
    return {name: value.detach().numpy().copy() for name, value in module.named_parameters()}


def test_it_trains_and_sends_no_illegal_action(session, request) -> None:
    log, before, after = session
    assert log.steps >= 100
    assert log.claims > 50
    assert log.illegal == 0
    assert all(np.isfinite(value).all() for value in after.values())
    changed = sum((before[name] != after[name]).any() for name in before)
    assert changed >= getattr(request.module, "CHANGED_SHARE", 1.0) * len(before)
    assert log.orders == {("arm_0", "arm_1", "arm_2")}


def test_a_seed_repeats_the_training_and_another_does_not(small_workshop, request) -> None:
    (_, one), (_, again), (_, other) = (request.module.trained(small_workshop(), seed) for seed in (0, 0, 1))
    for name in one:
        np.testing.assert_array_equal(again[name], one[name])
    assert any((other[name] != one[name]).any() for name in one)


def test_the_hash_seed_changes_nothing(elsewhere, request) -> None:
    assert elsewhere(request.module.__file__, 1) == elsewhere(request.module.__file__, 2)
