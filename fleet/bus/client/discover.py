"""Fleets at a router, found by the tokens of their arms and auctioneers."""

from fleet.bus.client.router import open_client
from fleet.bus.protocol import keys
from fleet.bus.security.access_control import ROSTER, read_roster
from fleet.bus.security.tls import identified

OURS = keys.PREFIX.rpartition("/")[2]
"""Version of the bus that this program uses."""
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


def other_versions(endpoint: str, fleet: str, *, timeout_s: float = 2.0) -> tuple[str, ...]:
    """Return a sentence on each participant of a fleet that uses another version of the bus, by name.

    With TLS there is none: the router lets nobody see them.

    Raises:
        BusError: no router accepted the connection.
    """
    if identified(endpoint)[1] is not None:
        return ()
    found: set[tuple[str, str]] = set()
    with open_client(endpoint, timeout_s=timeout_s) as session:
        for reply in session.liveliness().get(keys.tokens_of_all_versions(fleet), timeout=timeout_s):
            peer = None if reply.ok is None else keys.other_version(str(reply.ok.key_expr))
            found |= {peer} if peer else set()
    return tuple(
        f"'{name}' uses version {version} of the bus, and this program {OURS}: it takes no part. Use one version."
        for name, version in sorted(found)
    )
