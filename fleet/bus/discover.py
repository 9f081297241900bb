"""Which fleets meet at a router: read off the tokens of their arms and auctioneers."""

from fleet.bus import keys
from fleet.bus.router import open_client

EVERYBODY = f"{keys.PREFIX}/*/*/*/alive"


def fleets_at(endpoint: str, *, timeout_s: float = 5.0) -> tuple[str, ...]:
    """Names of the fleets of which somebody is there, in order.

    Raises:
        BusError: no router answered.
    """
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
