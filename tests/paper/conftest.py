"""The caches of the studies' tests."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def plans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache that all tests of a run share; never the user's."""
    return tmp_path_factory.getbasetemp() / "cache"


@pytest.fixture(autouse=True)
def own_cache(plans: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twins and plans of the tests are in their own cache."""
    monkeypatch.setenv("THERMOFLEET_CACHE", str(plans))
