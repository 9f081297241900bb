"""Addresses and tokens of `thermofleet gateway`."""

import re

import pytest

from fleet.errors import FleetError
from scenarios.cli.live.gateway import check


@pytest.mark.parametrize(
    ("host", "token", "says"),
    [
        ("0.0.0.0", "", "THERMOFLEET_TOKEN"),
        ("192.0.2.1", "", "reachable from other machines"),
        ("0.0.0.0", "short", "16"),
        ("localhost", "", "IP address"),
    ],
)
def test_other_machines_need_a_token(host, token, says):
    with pytest.raises(FleetError, match=re.escape(says)):
        check(host, token)


def test_with_a_token_any_address_is_allowed_with_a_warning(caplog):
    check("0.0.0.0", "sixteen-or-more-characters")
    assert "not encrypted" in caplog.text
