"""Fleets at a router, found by the tokens of their arms and auctioneers."""

from fleet.bus.client.router import open_client
from fleet.bus.protocol import keys
from fleet.bus.security.access_control import ROSTER, read_roster
from fleet.bus.security.tls import identified

EVERYBODY = f"{keys.PREFIX}/*/*/*/alive"


def fleets_at(endpoint: str, *, timeout_s: float = 5.0) -> tuple[str, ...]:
    """Names of the fleets with a present participant, sorted.

    With TLS no participant may look beyond its own fleet, which the roster in its folder names, if there is one.

    Raises:
        BusError: no router accepted the connection.
    """
    _, tls = identified(endpoint)
    if tls is not None:
        return (read_roster(tls.folder).fleet,) if (tls.folder / ROSTER).exists() else ()
    found: set[str] = set()
    with open_client(endpoint, timeout_s=timeout_s) as session:
        for reply in session.liveliness().get(EVERYBODY, timeout=timeout_s):
            if reply.ok is None:
                continue
            try:
                found.add(keys.parse(str(reply.ok.key_expr)).fleet)
            except ValueError:
                continue  # a token of somebody else
    return tuple(sorted(found))
