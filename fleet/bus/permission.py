"""What the one who connects may ask, read off its own certificate: so that it is told, where a router only drops.

The router keeps the rules, whatever is thought here.
"""

from typing import get_args
from urllib.parse import unquote

from fleet.bus.roster import Participant, Rights, Role, rights
from fleet.bus.security import identified


def participant_at(endpoint: str) -> Participant | None:
    """Who connects at an endpoint, by its certificate; None without TLS, or if the certificate says nothing of ours.

    Raises:
        BusError: there is no such certificate, or it is damaged.
    """
    _, tls = identified(endpoint)
    if tls is None:
        return None
    # Not at the top: whoever has no TLS shall not wait for the library.
    from fleet.bus.certificates import common_name, read

    role, _, name = common_name(read(tls.folder, tls.file)).partition(":")
    for known in get_args(Role):
        if role == known:
            return Participant(unquote(name), known)
    return None


def rights_by_role(fleet: str, name: str) -> dict[str, Rights]:
    """What one of this name could do in each role."""
    return {role: rights(fleet, Participant(name, role)) for role in get_args(Role)}
