"""Distances of arms along their paths, against MuJoCo's and against every pair of postures."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from fleet.arm.model import ArmModel, build_cell
from fleet.arm.space import Capsules, clearance, conflict, segment_distance
from fleet.robot import Mount, Robot

ROUND = ("shoulder", "half_arm_1", "half_arm_2", "forearm", "wrist_1", "wrist_2")
"""Links that are capsules in the MuJoCo model, too."""


@pytest.fixture(scope="module")
def robots():
    return [Robot(name="a"), Robot(name="b", mount=Mount(position_m=(0.5, 0.3, 0.0), tilt_deg=(0.0, 0.0, 70.0)))]


@pytest.fixture(scope="module")
def capsules(robots):
    return [Capsules(ArmModel(robot)) for robot in robots]


def path(seed, postures=30):
    """A smooth random path, rad, [posture, joint]."""
    draw = np.random.default_rng(seed)
    ends = draw.uniform(-2.0, 2.0, (2, 7))
    return ends[0] + np.linspace(0, 1, postures)[:, None] * (ends[1] - ends[0])


def test_links_are_as_far_apart_as_mujoco_says(robots, capsules):
    model = build_cell(robots)
    data = mujoco.MjData(model)
    for seed in range(20):
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, (2, 7))
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        one, other = (c.sweep(joints[None]) for c, joints in zip(capsules, q, strict=True))
        for i, link in enumerate(one.links):
            for j, other_link in enumerate(other.links):
                geoms = model.geom(f"a/{link}").id, model.geom(f"b/{other_link}").id
                true_m = mujoco.mj_geomDistance(model, data, *geoms, 5.0, None)
                ours_m = segment_distance(one.ends_m[i, 0], other.ends_m[j, 0]) - one.radius_m[i] - other.radius_m[j]
                if link in ROUND and other_link in ROUND:
                    assert ours_m == pytest.approx(true_m, abs=1e-5)
                else:
                    assert ours_m <= true_m + 1e-5  # a capsule around a cylinder or box


@pytest.mark.parametrize("seed", range(6))
def test_the_tree_finds_the_closest_of_all_pairs_of_postures(capsules, seed):
    one, other = (c.sweep(path(2 * seed + n, 50), payload_kg=2.0) for n, c in enumerate(capsules))
    closest = min(
        segment_distance(one.ends_m[i, p], other.ends_m[j, q]) - one.radius_m[i] - other.radius_m[j]
        for i in range(len(one.links))
        for j in range(len(other.links))
        for p in range(0, 50, 7)
        for q in range(0, 50, 7)
    )
    found = clearance(one, other)
    assert found is not None
    assert found.distance_m <= closest + 1e-6  # float32
    assert clearance(other, one).distance_m == pytest.approx(found.distance_m, abs=1e-6)
    assert conflict(one, other, found.distance_m + 1e-4)
    assert not conflict(one, other, found.distance_m - 1e-4)
    assert clearance(one, other, found.distance_m - 1e-4) is None


coordinate = st.floats(-2, 2, width=32)
segment = st.tuples(st.tuples(*[coordinate] * 3), st.tuples(*[coordinate] * 3)).map(np.array)


@given(segment, segment)
def test_segments_are_as_far_apart_as_a_search_finds(a, b):
    def apart(st):
        return float(np.sum((a[0] + st[0] * (a[1] - a[0]) - b[0] - st[1] * (b[1] - b[0])) ** 2))

    starts = [(s, t) for s in (0.0, 0.5, 1.0) for t in (0.0, 0.5, 1.0)]
    best = min(minimize(apart, start, bounds=[(0, 1), (0, 1)]).fun for start in starts)
    assert segment_distance(a, b) <= np.sqrt(best) + 1e-4
    assert segment_distance(a, b) >= np.sqrt(best) - 1e-4
