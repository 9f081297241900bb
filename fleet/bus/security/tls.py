"""Mutual TLS: the certificate of one end of a connection, and why a connection failed.

Connections are encrypted and authenticated: the router shows a certificate of its host, every other participant one of
its own name (`arm:arm_0`). `fleet.bus.security.access_control` defines what each may do.
"""

import logging
import os
import socket
import ssl
from collections.abc import Container
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast
from urllib.parse import unquote

from fleet.bus.security.access_control import ROLES, ROSTER, Role, RosterEntry, file_of, read_roster
from fleet.errors import BusError, is_name

if TYPE_CHECKING:  # plain TCP does not need the library
    from cryptography import x509

_LOG = logging.getLogger(__name__)

REMIND = timedelta(days=14)
"""A certificate with less time left is logged as a warning."""
_PROBE_S = 1.0
_UNKNOWN_AUTHORITY = (18, 19, 20, 21)
"""OpenSSL's codes (X509_V_ERR_…) for a certificate of an unknown authority."""


@dataclass(frozen=True)
class Tls:
    """One end of a connection: a participant, and the folder with its certificate, its key and `ca.pem`."""

    folder: Path
    name: str

    def check(self, *, serves: bool) -> None:
        """Refuse a connection that would fail.

        Args:
            serves: Whether this end listens, as the router does.

        Raises:
            BusError: a file is missing, damaged, expired or of another authority, or the key is readable by others.
        """
        # Imported late: plain TCP does not need the library.
        from fleet.bus.security.certificates import check, common_name, format_time, readable_by_others

        certificate = check(self.folder, self.file)
        owner = common_name(certificate)
        if owner.startswith("router:") != serves:
            needs = "a router needs that of a router" if serves else "only the router may use it"
            raise BusError(f"'{self.folder / self.file}.pem' is the certificate of '{owner}'; {needs}.")
        key = self._path(f"{self.file}.key")
        if readable_by_others(key):
            raise BusError(f"Others on this machine may read the private key '{key}': chmod 600 it.")
        expires = certificate.not_valid_after_utc
        if expires - datetime.now(UTC) < REMIND:
            renew = "thermofleet bus keys --add renews it"
            _LOG.warning("The certificate of '%s' ends on %s; %s.", owner, format_time(expires), renew)

    def link(self, *, serves: bool) -> dict[str, Any]:
        """Zenoh's settings for the connections of this end."""
        end = "listen" if serves else "connect"
        return {
            "root_ca_certificate": str(self._path("ca.pem")),
            f"{end}_certificate": str(self._path(f"{self.file}.pem")),
            f"{end}_private_key": str(self._path(f"{self.file}.key")),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            # A connection is closed when its certificate expires.
            "close_link_on_expiration": True,
        }

    def endpoint(self, address: str) -> str:
        """An address `tls/HOST:PORT` with this participant; the inverse of `identified`."""
        return f"{address}#{self.folder / self.file}"

    def context(self) -> ssl.SSLContext:
        """The same settings for Python's own TLS."""
        context = ssl.create_default_context(cafile=self._path("ca.pem"))
        context.load_cert_chain(self._path(f"{self.file}.pem"), self._path(f"{self.file}.key"))
        return context

    @property
    def file(self) -> str:
        """Name of its files, without the ending."""
        return file_of(self.name)

    def _path(self, file: str) -> Path:
        return Path(os.path.abspath(self.folder)) / file


def identified(endpoint: str) -> tuple[str, Tls | None]:
    """Address and participant of an endpoint `tls/HOST:PORT#FOLDER/NAME`; None if it names no participant.

    NAME is the file name of the certificate without its ending, so every name can be written.

    Raises:
        BusError: NAME cannot be the name of a participant.
    """
    address, _, path = endpoint.partition("#")
    if not (path and address.startswith("tls/")):
        return endpoint, None
    name = unquote(Path(path).name)
    if not is_name(name):
        raise BusError(f"Endpoint '{endpoint}' names no participant. Expected {address}#FOLDER/NAME.")
    return address, Tls(Path(path).parent, name)


def participant_at(endpoint: str) -> RosterEntry | None:
    """The participant in the certificate of an endpoint; None without TLS, or if the certificate names none.

    Raises:
        BusError: the certificate is missing or damaged.
    """
    certificate = _certificate_at(endpoint)
    if certificate is None:
        return None
    from fleet.bus.security.certificates import common_name

    role, _, name = common_name(certificate).partition(":")
    return RosterEntry(unquote(name), cast(Role, role)) if role in ROLES else None


def check_listed(endpoint: str, participant: RosterEntry, fleet: str) -> None:
    """Refuse a participant for which a router forwards nothing, by the roster in its folder; without one do nothing.

    Raises:
        BusError: the roster does not list the participant, is that of another fleet, or is damaged.
    """
    _, tls = identified(endpoint)
    if tls is None or not (tls.folder / ROSTER).exists():
        return
    roster, path = read_roster(tls.folder), tls.folder / ROSTER
    if participant.common_name not in {each.common_name for each in roster.participants}:
        raise BusError(
            f"'{participant.common_name}' is not in '{path}', so a router with this roster forwards none of its "
            "messages: add it with thermofleet bus keys --add, or copy the roster of the router."
        )
    if fleet != roster.fleet:
        raise BusError(
            f"The certificates in '{tls.folder}' are for the fleet '{roster.fleet}', so a router forwards nothing of "
            f"the fleet '{fleet}'. Give the fleet '{roster.fleet}', or certificates of '{fleet}'."
        )


def expires_at(endpoint: str) -> datetime | None:
    """When the certificate of an endpoint expires; None without TLS.

    Raises:
        BusError: the certificate is missing or damaged.
    """
    certificate = _certificate_at(endpoint)
    return None if certificate is None else certificate.not_valid_after_utc


UNKNOWN_CERTIFICATE = " Or the router does not know this certificate: it reads its roster when it starts."
"""Another cause of a fleet that seems to be empty, as a sentence after a space."""


def unknown_certificate_hint(endpoint: str) -> str:
    """`UNKNOWN_CERTIFICATE`; "" without TLS."""
    return "" if identified(endpoint)[1] is None else UNKNOWN_CERTIFICATE


def _certificate_at(endpoint: str) -> "x509.Certificate | None":
    _, tls = identified(endpoint)
    if tls is None:
        return None
    from fleet.bus.security.certificates import read

    return read(tls.folder, tls.file)


def is_past(moment: datetime) -> bool:
    """Whether a moment, as the end of a certificate, is over by the clock of this machine."""
    return datetime.now(UTC) >= moment


_NO_REPLY = "no reply to the TLS handshake: the server is suspended or overloaded, or does not use TLS"


class Trial(NamedTuple):
    """Result of a trial handshake with a router."""

    reason: str
    """Why a connection fails; "" if the handshake gives no reason."""
    stays: bool
    """Whether it will also fail later."""
    server: str = ""
    """Common name in the certificate of the server, as `router:router_2`; "" if the handshake fails before."""


def try_connection(host: str, port: int, tls: Tls | None, known: Container[str] = ()) -> Trial:
    """Find out why a connection to a router fails.

    Args:
        known: Common names of servers; for one of these no reason is looked for.
    """
    try:
        with socket.create_connection((host, port), timeout=_PROBE_S) as line:
            reason, server = (_why_not_plain(line), "") if tls is None else _why_not_tls(line, host, tls, known)
    except OSError as error:
        return Trial(error.strerror or str(error), stays=False)
    return Trial(reason, reason not in ("", _NO_REPLY), server)


def _why_not_plain(line: socket.socket) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with suppress(OSError), context.wrap_socket(line):
        return "the server expects TLS: a certificate and an endpoint that begins with tls/ are needed"
    return ""


def _why_not_tls(line: socket.socket, host: str, tls: Tls, known: Container[str]) -> tuple[str, str]:
    """Return why a connection fails, and the common name of the server."""
    server, accepted = "", False
    try:
        with tls.context().wrap_socket(line, server_hostname=host) as secure:
            server, accepted = _server_name(secure), True
            if server not in known:
                # In TLS 1.3 the server checks our certificate after our half of the handshake; a read gets its error.
                secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        hint = (
            f"; are the keys in '{tls.folder}' those of another fleet?"
            if error.verify_code in _UNKNOWN_AUTHORITY
            else ""
        )
        return f"the server's certificate is not valid: {error.verify_message}{hint}", server
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        if "alert" in reason:
            return f"the router refuses the certificate of '{tls.name}': {reason.partition('alert ')[2]}", server
        return f"the server does not use TLS: {reason}", server
    except TimeoutError:
        return "" if accepted else _NO_REPLY, server
    return "", server


def _server_name(secure: ssl.SSLSocket) -> str:
    subject = cast(tuple[tuple[tuple[str, str]], ...], (secure.getpeercert() or {}).get("subject", ()))
    return next((value for ((field, value),) in subject if field == "commonName"), "")
