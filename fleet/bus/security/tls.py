"""Mutual TLS: the certificate of one end of a connection, and why a connection failed.

Connections are encrypted and authenticated: the router shows a certificate of its host, every other participant one of
its own name (`arm:arm_0`). `fleet.bus.security.access_control` defines what each may do.
"""

import logging
import os
import socket
import ssl
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_args
from urllib.parse import unquote

from fleet.bus.security.access_control import Participant, Role, file_of
from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

REMIND = timedelta(days=14)
"""A certificate that expires sooner is logged as a warning."""
_PROBE_S = 1.0
_STRANGERS = (18, 19, 20, 21)
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
        # Not at the top: whoever has no TLS shall not wait for the library.
        from fleet.bus.security.certificates import check, common_name, told

        certificate = check(self.folder, self.file)
        who = common_name(certificate)
        if who.startswith("router:") != serves:
            needs = "a router needs that of a router" if serves else "only the router may use it"
            raise BusError(f"'{self.folder / self.file}.pem' is the certificate of '{who}'; {needs}.")
        self._check_secret()
        left = certificate.not_valid_after_utc - datetime.now(UTC)
        if left < REMIND:
            ends = told(certificate.not_valid_after_utc)
            _LOG.warning("The certificate of '%s' ends on %s; thermofleet keys --add renews it.", who, ends)

    def link(self, *, serves: bool) -> dict[str, Any]:
        """Zenoh's settings for the connections of this end."""
        end = "listen" if serves else "connect"
        return {
            "root_ca_certificate": str(self._path("ca.pem")),
            f"{end}_certificate": str(self._path(f"{self.file}.pem")),
            f"{end}_private_key": str(self._path(f"{self.file}.key")),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            # A connection ends with the certificate it was opened with.
            "close_link_on_expiration": True,
        }

    def endpoint(self, address: str) -> str:
        """An address `tls/HOST:PORT` together with who connects there, the inverse of `identified`."""
        return f"{address}#{self.folder / self.file}"

    def context(self) -> ssl.SSLContext:
        """The same end for Python's own TLS."""
        context = ssl.create_default_context(cafile=self._path("ca.pem"))
        context.load_cert_chain(self._path(f"{self.file}.pem"), self._path(f"{self.file}.key"))
        return context

    @property
    def file(self) -> str:
        """Name of its files, without the ending."""
        return file_of(self.name)

    def _path(self, file: str) -> Path:
        return Path(os.path.abspath(self.folder)) / file

    def _check_secret(self) -> None:
        path = self._path(f"{self.file}.key")
        if os.name == "posix" and path.stat().st_mode & 0o077:
            raise BusError(f"Others on this machine may read the private key '{path}': chmod 600 it.")


def identified(endpoint: str) -> tuple[str, Tls | None]:
    """Address and participant of an endpoint `tls/HOST:PORT#FOLDER/NAME`; None where it names no participant.

    NAME is the participant's file without its ending, so that every name can be written.
    """
    address, mark, who = endpoint.partition("#")
    if not (mark and who and address.startswith("tls/")):
        return endpoint, None
    return address, Tls(Path(who).parent, unquote(Path(who).name))


def participant_at(endpoint: str) -> Participant | None:
    """Who connects at an endpoint, by its certificate; None without TLS, or if the certificate names no participant.

    Raises:
        BusError: the certificate is missing or damaged.
    """
    _, tls = identified(endpoint)
    if tls is None:
        return None
    # Not at the top: without TLS nobody waits for this import.
    from fleet.bus.security.certificates import common_name, read

    role, _, name = common_name(read(tls.folder, tls.file)).partition(":")
    for known in get_args(Role):
        if role == known:
            return Participant(unquote(name), known)
    return None


def why_not(host: str, port: int, tls: Tls | None) -> str:
    """Why a connection to a router fails, by a trial handshake; "" if that gives no reason."""
    try:
        with socket.create_connection((host, port), timeout=_PROBE_S) as line:
            return _speaks_tls(line) if tls is None else _handshake(line, host, tls)
    except OSError as error:
        return error.strerror or str(error)


def _speaks_tls(line: socket.socket) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with suppress(OSError), context.wrap_socket(line):
        return "what listens there speaks TLS: a certificate and an endpoint that begins with tls/ are needed"
    return ""


def _handshake(line: socket.socket, host: str, tls: Tls) -> str:
    shaken = False
    try:
        with tls.context().wrap_socket(line, server_hostname=host) as secure:
            shaken = True
            # In TLS 1.3 the other end judges our certificate after our half is done: its verdict is the first we read.
            secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        doubt = f"; are the keys in '{tls.folder}' those of another fleet?" if error.verify_code in _STRANGERS else ""
        return f"the certificate of what listens there is refused: {error.verify_message}{doubt}"
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        if "alert" in reason:
            return f"the router refuses the certificate of '{tls.name}': {reason.partition('alert ')[2]}"
        return f"what listens there speaks no TLS: {reason}"
    except TimeoutError:
        return "" if shaken else "what listens there speaks no TLS: it does not answer"
    return ""
