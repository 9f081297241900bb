"""Addresses and tokens of `thermofleet bus gateway`."""

import re

import pytest

from fleet.errors import FleetError
from scenarios.live.gateway import check, check_token, read_tokens

PLAIN, SECURE = "tcp/127.0.0.1:7447", "tls/127.0.0.1:7447"


@pytest.mark.parametrize(
    ("host", "endpoint", "says"),
    [
        ("0.0.0.0", PLAIN, "THERMOFLEET_TOKEN"),
        ("192.0.2.1", PLAIN, "reachable from other machines"),
        ("127.0.0.1", SECURE, "every user of this machine"),
        ("localhost", PLAIN, "IP address"),
    ],
)
def test_other_machines_and_users_need_a_token(host, endpoint, says):
    with pytest.raises(FleetError, match=re.escape(says)):
        check(host, endpoint, has_tokens=False)


def test_with_a_token_any_address_is_allowed_with_a_warning(caplog):
    check("0.0.0.0", SECURE, has_tokens=True)
    assert "not encrypted" in caplog.text


@pytest.mark.parametrize(
    ("content", "mode", "says"),
    [
        ("operator sixteen-or-more-characters", 0o644, "chmod 600"),
        ("operater sixteen-or-more-characters", 0o600, "line 1: no role 'operater'; did you mean 'operator'?"),
        ("operator short", 0o600, "16 or more"),
        ("# nothing", 0o600, "holds no tokens"),
    ],
)
def test_a_file_of_tokens_says_what_is_wrong_with_it(tmp_path, content, mode, says):
    path = tmp_path / "tokens"
    path.write_text(content)
    path.chmod(mode)
    with pytest.raises(FleetError, match=re.escape(says)):
        read_tokens(path)


def test_a_token_is_long_and_ascii():
    assert check_token("sixteen-or-more-characters")
    for bad in ("short", "sixteen-or-more-\n", "sixteen-or-more-ä"):
        with pytest.raises(FleetError, match="16 or more printable ASCII"):
            check_token(bad)
