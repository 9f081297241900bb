"""A fleet of model arms."""

from types import SimpleNamespace

import pytest

from tests.live.model_arm import TIMING, ModelArm
from tests.live.model_fleet import ModelFleet


@pytest.fixture(scope="session")
def live() -> SimpleNamespace:
    """Classes of the model fleet."""
    return SimpleNamespace(Arm=ModelArm, Fleet=ModelFleet, TIMING=TIMING)
