"""The router of a fleet, its limits, the transport settings of all sessions, and the fleets at a router.

Plain TCP does not authenticate, so it is limited to loopback. With TLS both ends of every connection are authenticated,
and the router enforces the access control of its roster.
"""

import ipaddress
import json
import logging
import re
import socket
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any, Self

import zenoh

from fleet.bus.protocol import keys
from fleet.bus.protocol.keys import SESSION_LEASE_S
from fleet.bus.protocol.messages import MOST_BYTES
from fleet.bus.protocol.policy import MOST_REQUEST_BYTES
from fleet.bus.security.access_control import ROSTER, Roster, RosterEntry, access_control, read_roster
from fleet.bus.security.tls import Tls, identified, participant_at, try_connection
from fleet.errors import BusError, NoRouter, StoppedWaiting, listed

_LOG = logging.getLogger(__name__)

_TURN_S = 1.0
"""Real seconds of one attempt while waiting for a router."""
_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<host>[^:\[\]/?#]+)):(?P<port>\d{1,5})")
_ANY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}
"""Wildcard addresses of a listener, and the address at which this machine reaches it."""

_SCOUTING: Mapping[str, Any] = {
    # Otherwise a router waits half a second to discover others.
    "delay": 0,
    "multicast": {"enabled": False},
    "gossip": {"enabled": False},
}
_ACCEPTING: Mapping[str, Any] = {
    # Too many half-open connections keep new ones out (by default 100, 10 s).
    "accept_pending": 1000,
    "accept_timeout": 3000,
    # A closing session waits this long for a connection to a stopped router.
    "open_timeout": 3000,
}
_RETRY: Mapping[str, Any] = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
_SENDING: Mapping[str, Any] = {
    "lease": round(1000 * SESSION_LEASE_S),
    "queue": {
        "size": {"data": 16},
        # Microseconds: enough for a burst of a whole fleet on a busy machine; a stuck peer is not waited for.
        "congestion_control": {"drop": {"wait_before_drop": 20_000}, "block": {"wait_before_close": 1_000_000}},
    },
}


def loopback(endpoint: str) -> str:
    """The endpoint, if it is `tcp/<address>:<port>` on loopback.

    Raises:
        BusError: it is not, with the reason.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or match["protocol"] != "tcp" or not 0 <= int(match["port"]) <= 65535:
        raise BusError(
            f"'{endpoint}' is no endpoint of this bus. Expected tcp/<address>:<port>, as tcp/127.0.0.1:7447."
        )
    host = match["v6"] or match["host"]
    if host == "localhost":
        return endpoint
    try:
        address = ipaddress.ip_address(host)
    except ValueError as error:
        raise BusError(
            f"Endpoint '{endpoint}': '{host}' may resolve to another machine. "
            "Without TLS, allowed: 127.0.0.1, [::1], localhost."
        ) from error
    if not address.is_loopback:
        raise BusError(
            f"Endpoint '{endpoint}' is not on loopback. Plain TCP does not authenticate, so any process that reaches "
            "it could act as any arm. Allowed: 127.0.0.1, [::1], localhost; other hosts need tls/ and certificates "
            "of thermofleet bus keys."
        )
    return endpoint


def reachable(endpoint: str, tls: Tls | None = None) -> str:
    """The endpoint, if a session may connect to it: on loopback without TLS, on any host with it.

    Raises:
        BusError: it may not, with the reason.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if tls is None and match is not None and match["protocol"] == "tls":
        raise BusError(f"Endpoint '{endpoint}' needs a certificate; name it, as {endpoint}#FOLDER/NAME.")
    if tls is None:
        return loopback(endpoint)
    if match is None or match["protocol"] != "tls" or not 0 < int(match["port"]) <= 65535:
        raise BusError(
            f"'{endpoint}' is no endpoint for the certificate of '{tls.name}'. Expected tls/<address>:<port>, as "
            "tls/127.0.0.1:7447."
        )
    return endpoint


def reached_at(host: str) -> str:
    """Address, as in an endpoint, at which this machine reaches a router that listens on `host`."""
    bare = host.strip("[]")
    return _ANY_ADDRESS.get(bare, f"[{bare}]" if ":" in bare else bare)


class Session:
    """Base of what has a Zenoh session from `open` to `close`, or in a `with` block."""

    def __init__(self) -> None:
        self._session: zenoh.Session | None = None
        self._resources = ExitStack()
        # A process that exits without closing its session would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    def open(self) -> Self:
        """Open the session; does nothing if it is open.

        Raises:
            BusError: the session cannot be opened.
        """
        if self._session is None:
            self._session = self._new_session()
            self._resources.callback(self._session.close)
        return self

    def close(self) -> None:
        """Close the session; may be called twice.

        Raises:
            BusError: it did not close cleanly.
        """
        self._session = None
        try:
            self._resources.close()
        except zenoh.ZError as error:
            raise BusError(f"The {type(self).__name__} did not close cleanly ({plain_reason(error)}).") from error

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _new_session(self) -> zenoh.Session:
        raise NotImplementedError

    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError(f"The {type(self).__name__} is not open. Use it as a context manager.")
        return self._session

    def _keep(self, entity: object) -> None:
        """Keep a declared entity until the session is closed: Zenoh undeclares what is garbage-collected."""
        self._resources.callback(lambda: entity)


class Connection(Session):
    """A client session on a router.

    Args:
        endpoint: As of `open_client`.
        timeout_s: How long the router may take to accept the connection.
        stopped: Wait for a router until this is true, instead of `timeout_s`.
    """

    def __init__(self, endpoint: str, timeout_s: float, stopped: Callable[[], bool] | None = None) -> None:
        super().__init__()
        self._endpoint, self._timeout_s, self._stopped = endpoint, timeout_s, stopped

    @property
    def connected(self) -> bool:
        """Whether it has a connection to a router now; a lost one is restored by Zenoh."""
        return self._session is not None and bool(self._session.info.routers_zid())

    def _new_session(self) -> zenoh.Session:
        if self._stopped is None:
            return open_client(self._endpoint, timeout_s=self._timeout_s)
        waits = False
        while not self._stopped():
            try:
                return open_client(self._endpoint, timeout_s=_TURN_S)
            except NoRouter as error:
                if not waits:
                    _LOG.warning("Waiting for a router. %s", error)
                waits = True
        raise StoppedWaiting(f"Stopped while waiting for a router at {self._endpoint}.")


def open_client(endpoint: str, *, timeout_s: float, tls: Tls | None = None) -> zenoh.Session:
    """A client session on the router at `endpoint`.

    Args:
        endpoint: As `tcp/127.0.0.1:7447`, or with the participant as `tls/127.0.0.1:7447#FOLDER/NAME`.
        tls: The participant, for an endpoint that begins with `tls/` and does not name one.

    Raises:
        BusError: the endpoint is not on loopback and has no TLS, or the certificate is not valid.
        NoRouter: no router answered within `timeout_s`.
    """
    if tls is None:
        endpoint, tls = identified(endpoint)
    connect = {
        "endpoints": [reachable(endpoint, tls)],
        "timeout_ms": max(1, round(1000 * timeout_s)),
        "retry": _RETRY,
    }
    link = {"tx": _SENDING}
    if tls is not None:
        tls.check(serves=False)
        link["tls"] = tls.link(serves=False)
    try:
        return zenoh.open(_config({"mode": "client", "connect": connect}, link))
    except zenoh.ZError as error:
        trial = try_connection(*_address(endpoint), tls)
        sentence = f"No router answered at {endpoint} within {timeout_s} s ({trial.reason or plain_reason(error)})."
        raise (BusError if trial.stays else NoRouter)(sentence) from error


class Router(Session):
    """A router in this process, for the sessions of one fleet.

    `with Router() as router:` listens on a free port of 127.0.0.1 until the end of the block. Linked routers (Zenoh's
    router mode) forward messages between their sessions; each enforces the access control for its own ones.

    Sessions of its own process share Zenoh's two receiving threads with it, so that a large history (20 MB, on a busy
    machine) can close their connections again and again; in processes of their own they did not.
    """

    def __init__(
        self,
        port: int = 0,
        *,
        host: str = "127.0.0.1",
        tls: Tls | None = None,
        state_hz: float | None = None,
        connect: Sequence[str] = (),
    ) -> None:
        """Prepare a router.

        Args:
            port: TCP port; 0 lets the system choose a free one.
            host: Address to listen on; without TLS one of loopback.
            tls: The router's certificate; the roster of its folder sets the access control. None for plain TCP.
            state_hz: Telemetry messages a second, real time, forwarded of each session, or with TLS of each arm; None
                for any number. A steady stream needs a limit of twice its rate, as Zenoh limits the gap between two
                messages, which varies.
            connect: Endpoints of other routers of the fleet, `tls/HOST:PORT`. A link that is not there, or is lost, is
                tried again every second at most.

        Raises:
            BusError: plain TCP beyond loopback, a link without TLS, or no endpoint of TLS.
        """
        super().__init__()
        if not 0 <= port <= 65535:
            raise ValueError(f"A port is 0..65535 (got {port}).")
        if state_hz is not None and not 0 < state_hz < 1e6:
            raise ValueError(f"state_hz must be > 0, or None (got {state_hz}).")
        self._host = f"[{host.strip('[]')}]" if ":" in host else host
        self._port = port
        self._tls = tls
        self._state_hz = state_hz
        self._listen = f"{'tcp' if tls is None else 'tls'}/{self._host}:{port}"
        if tls is None:
            loopback(self._listen)
        elif _ENDPOINT.fullmatch(self._listen) is None:
            raise BusError(f"'{host}' is no address to listen on, as 127.0.0.1 or 0.0.0.0.")
        if connect and tls is None:
            raise BusError(
                f"A link to another router ({connect[0]}) needs TLS: routers recognise each other by certificates. "
                "Start both with --tls."
            )
        self._connect = [reachable(endpoint, tls) for endpoint in connect]
        self._reported: dict[str, str] = {}
        """Last result of `_link_fault` by endpoint."""
        self._endpoint = ""

    @property
    def endpoint(self) -> str:
        """Where sessions connect, as `tcp/127.0.0.1:7447`.

        Raises:
            BusError: the router is not open.
        """
        self._open()
        return self._endpoint

    def _new_session(self) -> zenoh.Session:
        """Listen; raises a BusError if the port is in use, none is free, or the certificate is not valid."""
        try:
            session = zenoh.open(self._settings())
        except zenoh.ZError as error:
            where = f"port {self._port} of {self._host}; is it in use?" if self._port else f"a port of {self._host}."
            raise BusError(f"The router could not listen on {where} ({plain_reason(error)})") from error
        try:
            self._endpoint = self._where(session)
        except BusError:
            session.close()
            raise
        return session

    def linked(self) -> int:
        """Number of other routers that it has a link to now."""
        return 0 if self._session is None else len(self._session.info.routers_zid())

    def link_changes(self) -> list[str]:
        """A sentence on each link of `connect` that is there, or is missing, otherwise than at the last call.

        A missing one is tried with a handshake for the reason, which may take seconds.
        """
        sentences: list[str] = []
        for endpoint in self._connect:
            fault = self._link_fault(endpoint)
            if self._reported.get(endpoint) != fault:
                self._reported[endpoint] = fault
                missing = f"No link to the router at {endpoint} ({fault}). It is tried again every second."
                sentences.append(missing if fault else f"Linked to the router at {endpoint}.")
        return sentences

    def _link_fault(self, endpoint: str) -> str:
        """Why there is no link to the router at an endpoint; "" if there is one."""
        assert self._tls is not None  # as for every link
        host, port = _address(endpoint)
        links = self._open().info.links()
        if {str(link.dst) for link in links} & _locators(host, port):
            return ""
        # The other router may have opened the link, or have several addresses: it is recognised by its certificate.
        linked, own = {link.auth_identifier for link in links}, RosterEntry(self._tls.name, "router").common_name
        trial = try_connection(host, port, self._tls, {*linked, own})
        if trial.server and trial.server in linked:
            return ""
        if trial.server == own:
            return "it is the address of this router, or of another one with the same certificate"
        return trial.reason or "it accepts the certificate, and the link is not open yet"

    def _settings(self) -> zenoh.Config:
        roster = None
        if self._tls is not None:
            self._tls.check(serves=True)
            roster = read_roster(self._tls.folder)
        own = {
            "mode": "router",
            "listen": {"endpoints": [self._listen]},
            # Without end and without failure: the other router may start later.
            "connect": {"endpoints": self._connect, "timeout_ms": -1, "exit_on_failure": False, "retry": _RETRY},
            # The admin space holds the port that the system chose.
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
            **limits(roster, self._state_hz),
        }
        link = {"tx": _SENDING, "rx": {"max_message_size": assembled_bytes(roster)}}
        if self._tls is not None and roster is not None:
            link["tls"] = self._tls.link(serves=True)
            if self._connect:
                link["tls"] |= self._tls.link(serves=False)
            own["access_control"] = access_control(roster, self._tls.name)
        return _config(own, link)

    def _where(self, session: zenoh.Session) -> str:
        """The endpoint that a router session listens on, from its admin space."""
        for reply in session.get(f"@/{session.zid()}/router", timeout=5.0):
            if reply.ok is None:
                continue
            locators = json.loads(reply.ok.payload.to_bytes())["locators"]
            ports = {locator.rsplit(":", 1)[1] for locator in locators}
            if len(ports) == 1:
                return f"{self._listen[:3]}/{reached_at(self._host)}:{ports.pop()}"
        raise BusError("The router opened, but its port is unknown.")


def limits(roster: Roster | None = None, state_hz: float | None = None) -> dict[str, Any]:
    """What a router forwards from each session, as Zenoh's configuration; the rest is dropped silently.

    Payload and attachment of a message may have `MOST_BYTES`. A request to a policy, or with a wildcard or an unknown
    role in its key, may have `MOST_REQUEST_BYTES` with plain TCP or a policy in the roster.

    Args:
        roster: Participants, if each is held to its own keys. The rate is then limited by key: one session, that of a
            linked router, may carry the telemetry of many arms.
        state_hz: As of `Router`.
    """
    all_keys = ["**", keys.caches_of("**")]
    # Of two filters that apply, the smaller one counts; only requests to policies may be larger.
    others = [f"{keys.PREFIX}/*/{role}/**" for role in keys.TOPICS if role != "policy"]
    # Of two limits of one key expression the last one counts, so each has one.
    sizes = [
        _size(["put", "delete", "reply"], all_keys, MOST_BYTES),
        _size(["query"], [*others, keys.caches_of("**")], MOST_BYTES),
        _size(["query"], ["**"], _largest_request(roster)),
    ]
    if state_hz is None:
        return {"low_pass_filter": sizes}
    if roster is None:
        limited = [keys.STATES]
    else:
        limited = [keys.of_arm(roster.fleet, arm, "state") for arm in roster.of_role("arm")]
    rate = {
        "flows": ["ingress"],
        "messages": ["put", "delete"],
        "rules": [{"key_expr": key, "freq": state_hz} for key in limited],
    }
    return {"low_pass_filter": sizes, "downsampling": [rate]}


def assembled_bytes(roster: Roster | None = None) -> int:
    """Largest fragmented message that the router assembles in memory before it checks its size."""
    return max(2 * MOST_BYTES, _largest_request(roster)) + MOST_BYTES


def _largest_request(roster: Roster | None) -> int:
    return MOST_BYTES if roster is not None and not roster.of_role("policy") else MOST_REQUEST_BYTES


def _size(messages: list[str], expressions: list[str], most_bytes: int) -> dict[str, Any]:
    return {"flows": ["ingress"], "messages": messages, "key_exprs": expressions, "size_limit": most_bytes}


def _config(own: Mapping[str, Any], link: Mapping[str, Any]) -> zenoh.Config:
    transport = {"shared_memory": {"enabled": False}, "unicast": _ACCEPTING, "link": link}
    return zenoh.Config.from_json5(json.dumps({"scouting": _SCOUTING, "transport": transport, **own}))


def _address(endpoint: str) -> tuple[str, int]:
    """Host and port of a valid endpoint."""
    host, port = endpoint[len("tcp/") :].rsplit(":", 1)
    return host.strip("[]"), int(port)


def _locators(host: str, port: int) -> set[str]:
    """Zenoh's names for the ends of a TLS link to a host."""
    try:
        addresses = {str(address[0]) for *_, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        return set()
    return {f"tls/[{address}]:{port}" if ":" in address else f"tls/{address}:{port}" for address in addresses}


def plain_reason(error: zenoh.ZError) -> str:
    """Zenoh's error text without locations in its source."""
    return re.split(r" at /|\.? \[", str(error))[0]


OURS = keys.PREFIX.rpartition("/")[2]
"""Version of the bus that this program uses."""
ALL_TOKENS = f"{keys.PREFIX}/*/*/*/alive"


def fleets_at(endpoint: str, *, timeout_s: float = 5.0) -> tuple[str, ...]:
    """Names of the fleets with a present participant other than a monitor, sorted.

    With TLS no participant may look beyond its own fleet, which the roster in its folder names, if there is one.

    Raises:
        BusError: no router accepted the connection, or the certificate is missing or damaged.
    """
    _, tls = identified(endpoint)
    if tls is not None:
        participant_at(endpoint)
        return (read_roster(tls.folder).fleet,) if (tls.folder / ROSTER).exists() else ()
    fleets: set[str] = set()
    for key in _tokens(endpoint, ALL_TOKENS, timeout_s):
        with suppress(ValueError):  # a foreign token
            if (parsed := keys.parse(key)).role != "monitor":
                fleets.add(parsed.fleet)
    return tuple(sorted(fleets))


def warn_of_absence(fleet: str, endpoint: str) -> None:
    """Log it if no participant of this fleet is online: its name may be mistyped. With TLS this is not known."""
    with suppress(BusError):  # the router ends at this moment, and may be back
        if identified(endpoint)[1] is None and fleet not in (fleets := fleets_at(endpoint)):
            there = f"Fleets at {endpoint}: {listed(fleets)}."
            _LOG.warning("No participant of the fleet '%s' is online yet. %s", fleet, there)


def other_versions(endpoint: str, fleet: str, *, timeout_s: float = 2.0) -> tuple[str, ...]:
    """Return a sentence on each participant of a fleet that uses another version of the bus, by name.

    With TLS there is none: the router hides them.

    Raises:
        BusError: no router accepted the connection.
    """
    if identified(endpoint)[1] is not None:
        return ()
    peers = set(map(keys.other_version, _tokens(endpoint, keys.tokens_of_all_versions(fleet), timeout_s)))
    return tuple(
        f"'{name}' uses version {version} of the bus, and this program {OURS}: it takes no part. Use one version."
        for name, version in sorted(peer for peer in peers if peer)
    )


def _tokens(endpoint: str, expression: str, timeout_s: float) -> list[str]:
    """Keys of the present liveliness tokens."""
    with open_client(endpoint, timeout_s=timeout_s) as session:
        replies = session.liveliness().get(expression, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
