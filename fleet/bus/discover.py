"""Which fleets meet at a router: read off the tokens of their arms and auctioneers."""

from fleet.bus import keys
from fleet.bus.roster import ROSTER, read_roster
from fleet.bus.router import open_client
from fleet.bus.security import identified

EVERYBODY = f"{keys.PREFIX}/*/*/*/alive"


def fleets_at(endpoint: str, *, timeout_s: float = 5.0) -> tuple[str, ...]:
    """Names of the fleets of which somebody is there, in order.

    With TLS nobody may look beyond its own fleet: that one is told by the roster in its folder, if there is one.

    Raises:
        BusError: no router answered.
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
                continue  # a token that no fleet of ours would show
    return tuple(sorted(found))
