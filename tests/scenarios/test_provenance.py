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


def test_a_calibrated_twin_names_the_source_of_its_twin():
    model = SimpleNamespace(version="ab12+ef56", twin=TWIN)
    assert provenance(model) == {"version": "ab12+ef56", "twin": provenance(TWIN)["twin"]}
