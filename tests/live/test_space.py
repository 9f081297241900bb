"""Names of spaces, and which plans of two arms exclude each other."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.arm.space import Sphere, space_name
from fleet.job import Place, Work
from fleet.live.space import ANYWHERE, CellSpace, arms_in_the_way

WORK = Work(kind="hold", places=(Place(name="bench", position_m=(0.5, 0.0, 0.2)),), payload_kg=2.0)
CELL = CellSpace(
    volume={"a": 0, "b": 1, "c": 2},
    conflicts=np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]], bool),
    workspaces={"one": Sphere(0, 0, 0, 1.5), "other": Sphere(2.9, 0, 0, 1.5), "far": Sphere(9, 0, 0, 1.5)},
    clearance_m=0.02,
)


def test_the_name_of_a_space_follows_from_the_values_of_the_plan():
    name = space_name(("arm", WORK, 1, 0.5))
    assert len(name) == 16
    same = replace(WORK, payload_kg=2, places=(replace(WORK.places[0], position_m=tuple(np.array([0.5, 0.0, 0.2]))),))
    assert space_name(("arm", same, np.int64(1), np.float64(0.5))) == name
    place = replace(WORK.places[0], retreat_m=0.1)
    others = [replace(WORK, payload_kg=2.1), replace(WORK, dwell_s=1.0), replace(WORK, places=(place,))]
    names = {space_name(("arm", work, 1, 0.5)) for work in others}
    names |= {space_name(key) for key in (("b", WORK, 1, 0.5), ("arm", WORK, 2, 0.5), ("arm", WORK, 1, 1.0))}
    assert len(names - {name}) == 6


@pytest.mark.parametrize(
    ("arm", "space", "other", "other_space", "excluded"),
    [
        ("one", "a", "other", "b", True),
        ("one", "a", "other", "c", False),
        ("one", "a", "other", "unknown", True),
        ("one", ANYWHERE, "other", "c", True),
        ("one", "a", "far", "unknown", False),
        ("one", "a", "outsider", "unknown", True),
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
    taken = {"one": ["a"], "other": ["c"], "far": []}
    assert arms_in_the_way("one", "b", taken, CELL) == ()
    assert arms_in_the_way("other", "b", taken, CELL) == ("one",)
    assert arms_in_the_way("one", None, taken, CELL) == ("other",)
