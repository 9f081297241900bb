"""A recording names what a score came from."""

from types import SimpleNamespace

from fleet.difficulty import Blind
from scenarios.run.log import provenance

TWIN = SimpleNamespace(version="ab12", data_hash="cd34", seed="[0, 1]/")


def test_a_model_without_data_has_its_version_only():
    assert provenance(Blind()) == {"version": "blind"}


def test_a_twin_names_its_data_and_seed():
    told = provenance(TWIN)
    assert told == {"version": "ab12", "twin": {"version": "ab12", "data_hash": "cd34", "seed": "[0, 1]/"}}


def test_a_calibrated_twin_names_both_sources():
    model = SimpleNamespace(
        version="ab12+ef56",
        twin=TWIN,
        saturation=SimpleNamespace(version="ef56", data_hash="9988", jobs=300, passed=40),
    )
    told = provenance(model)
    assert told["version"] == "ab12+ef56"
    assert told["twin"]["data_hash"] == "cd34"
    assert told["saturation"] == {"version": "ef56", "data_hash": "9988", "jobs": 300, "passed": 40}
