"""Names of spaces, and which plans of two arms exclude each other."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fleet.arm.planner import Planner
from fleet.arm.space import Sphere, path_of, space_name
from fleet.job import Place, Work
from fleet.live.space import ANYWHERE, CellSpace, arms_in_the_way
from fleet.robot import Robot

WORK = Work(kind="hold", places=(Place(name="bench", position_m=(0.5, 0.0, 0.2)),), payload_kg=2.0)
HIGHER = replace(WORK, places=(Place(name="bench", position_m=(0.5, 0.0, 0.3)),))
CELL = CellSpace(
    volumes={"a": (0, 2.0), "b": (1, 0.5), "c": (2, 1.0)},
    conflicts=np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]], bool),
    workspaces={"one": Sphere(0, 0, 0, 1.5), "other": Sphere(2.9, 0, 0, 1.5), "far": Sphere(9, 0, 0, 1.5)},
    clearance_m=0.02,
)


def test_the_name_of_a_space_states_the_path_and_the_payload_of_a_plan():
    """Planned anew with another speed, dwell and payload, and to another place."""
    names = [
        [space_name(plan) for plan in Planner(Robot(name="arm"), elbows=2).plan(work)]
        for work in (WORK, replace(WORK, dwell_s=7.0), replace(WORK, payload_kg=0.5), HIGHER)
    ]
    assert names[0] == names[1]  # two speeds along each path
    assert len(set(names[0])) == len(names[0]) // 2 == 2
    assert [path_of(name)[1] for name in (*names[0], *names[2])] == [2.0] * 4 + [0.5] * 4
    paths = [{path_of(name)[0] for name in each} for each in names]
    assert paths[0] == paths[2]
    assert not paths[0] & paths[3]
    assert path_of("sphere:1,2,3,4") == ("sphere:1,2,3,4", math.inf)


@pytest.mark.parametrize(
    ("arm", "space", "other", "other_space", "excluded"),
    [
        ("one", "a@2.0", "other", "b@0.5", True),
        ("one", "a@0.1", "other", "c@1.0", False),
        ("one", "a@0.1", "other", "c@1.01", True),  # heavier than what the table was made for
        ("one", "a", "other", "c@1.0", True),
        ("one", "a@x", "other", "c@1.0", True),
        ("one", "a@nan", "other", "c@1.0", True),
        ("one", "a@1e999", "other", "c@1.0", True),
        ("one", "a@-1", "other", "b@0.5", True),
        ("one", "a@1.0", "other", "unknown@1.0", True),
        ("one", ANYWHERE, "other", "c@1.0", True),
        ("one", "a@1.0", "far", "unknown@1.0", False),
        ("one", "a@1.0", "outsider", "unknown", True),
        ("far", ANYWHERE, "one", ANYWHERE, False),
        ("one", "a", "outsider", "sphere:-2.5,0,0,0.9", False),
        ("one", ANYWHERE, "outsider", "sphere:-2.5,0,0,0.9", False),
        ("one", "a", "outsider", "sphere:-2.5,0,0,0.99", True),  # nearer than the clearance
        ("outsider", "sphere:0,-5,0,1", "another", "sphere:0,-7.03,0,1", False),
        ("outsider", "sphere:0,-5,0,1", "another", "sphere:0,-7.01,0,1", True),
        ("outsider", "sphere:50,0,0,1", "another", ANYWHERE, True),
        ("one", "a", "outsider", "sphere:50,0,0,0", True),
        ("one", "a", "outsider", "sphere:50,0,0,-1", True),
        ("one", "a", "outsider", "sphere:50,0,1", True),
        ("one", "a", "outsider", "sphere:50,0,0,nan", True),
        ("one", "a", "outsider", "sphere:1e4,0,0,1", True),
        ("one", "a", "outsider", "ball:50,0,0,1", True),
        ("one", "sphere:0,0,0,0.1", "other", "sphere:2.9,0,0,0.1", False),  # it knows better
    ],
)
def test_spaces_of_a_cell_exclude_each_other_both_ways(arm, space, other, other_space, excluded):
    assert CELL(arm, space, other, other_space) == CELL(other, other_space, arm, space) == excluded


def test_an_arm_is_never_in_its_own_way():
    taken = {"one": ["a@1.0"], "other": ["c@1.0"], "far": []}
    assert arms_in_the_way("one", "b@0.5", taken, CELL) == ()
    assert arms_in_the_way("other", "b@0.5", taken, CELL) == ("one",)
    assert arms_in_the_way("one", None, taken, CELL) == ("other",)
