"""The bus over HTTP: the fleet as JSON, messages as server-sent events, job requests, and a page for browsers.

The bus is served on a thread (`fleet.live.monitor.async_bridge`); feed and reader buffers are used on the event loop
only. Errors are problem details (RFC 9457). The files of the page contain no data of a fleet and need no token; the
page asks for one and sends it with each request.
"""

import asyncio
import gzip
import hmac
import ipaddress
import json
import logging
import math
import os
import secrets
import signal
import socket
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from http import HTTPStatus
from pathlib import Path
from typing import (
    Annotated,
    Any,  # values of JSON
    Literal,
    TypeVar,
    get_args,
)

import msgspec
import uvicorn
from msgspec.structs import replace
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from fleet.bus.client import BusClient, NoReply
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec, QuoteRequest, StatusRequest, Submission, SubmissionReply
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.messages import MalformedMessage, PersonRequest, decode, encode
from fleet.bus.protocol.operator import (
    Alarm,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Person,
    ResetReply,
    ResetRequest,
    check_request,
    without_reset,
)
from fleet.bus.router import warn_of_absence
from fleet.bus.security.access_control import RosterEntry, rights_by_role
from fleet.bus.security.tls import participant_at
from fleet.env.render.heat import heat_scale
from fleet.errors import (
    JOB_RULE,
    NAME_RULE,
    BusError,
    FleetError,
    Refused,
    ScenarioError,
    is_name,
    listed,
    nearest,
    printable,
)
from fleet.live.job_client import batches
from fleet.live.monitor.async_bridge import MONITOR, AsyncBridge, EventFeed, FeedEntry
from fleet.live.monitor.health import Finding
from fleet.live.monitor.snapshot import MAX_JOBS
from fleet.live.supervisor import return_memory
from scenarios.cli.options import the_fleet
from scenarios.live.metrics import CONTENT_TYPE, exposition
from scenarios.live.webhooks import Webhook, webhooks_of
from scenarios.signals import until_stopped
from scenarios.spec.job_table import read_job_table, shift_begin, with_cell
from scenarios.spec.schema import Scenario
from scenarios.terminal import Interrupted, echo

_LOG = logging.getLogger(__name__)

Role = Literal["monitor", "submitter", "operator"]
ROLES: tuple[Role, ...] = get_args(Role)
"""Each role has the rights of the ones before it."""
TOKEN = "THERMOFLEET_TOKEN"
"""Environment variable of the operator's token."""
MIN_TOKEN = 16
LOCAL = ("127.0.0.1", "localhost", "[::1]")
RATE_HZ, BURST = 50.0, 100.0
"""Requests per real second of one token (without tokens: of one address), and size of a burst after a pause."""
MAX_SENDERS = 4096
"""Maximum number of tokens and addresses whose rate is kept."""
MAX_BYTES = 60_000
"""Size of a body: the limit of the router, less the overhead of a message."""
MAX_TABLE_BYTES = 1_000_000
"""Size of a job table."""
MAX_READERS, MAX_REQUESTS = 64, 16
BODY_S, STUCK_S, HEARTBEAT_S = 10.0, 10.0, 15.0
"""Real seconds for a body to arrive, for a reader to receive, and between two heartbeats."""
RETRY = {"Retry-After": "5"}
"""Headers of a response where the same request may succeed later."""
MAX_CONNECTIONS = 1000
MAX_WAITING = 128
"""Connections without a complete request; the next one closes the oldest."""
HEADER_S = 5.0
"""Real seconds until a connection without a complete request is closed."""
TABLE = "text/csv"
"""Content type of a job table."""
PARAMETERS: Mapping[tuple[str, str], Sequence[str]] = {
    ("GET", "/v4/fleet"): ("jobs",),
    ("GET", "/v4/jobs"): ("job",),
    ("POST", "/v4/jobs"): ("shift_begin", "by"),
}
"""Query parameters of a request, by method and path; of all others none."""
PAGE = "dashboard.html"
FILES = ("page.css", "dashboard.css", "cell.js", "stream.js", "tables.js", "actions.js", "dashboard.js")
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-cache",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Vary": "Accept, Accept-Encoding",
    "X-Content-Type-Options": "nosniff",
}


class LivePage:
    """The page of a gateway; without a model the cell is drawn as the auctioneer describes it."""

    def __init__(self, model: Mapping[str, Any] | None = None) -> None:
        self._model = model

    async def scene(self, ask_cell: Callable[[], Awaitable[Cell]]) -> Mapping[str, Any]:
        """The cell in three dimensions; raises BusError if no participant describes it, or with invalid numbers."""
        if self._model is not None:
            return self._model
        try:
            return await asyncio.to_thread(_model_of, await ask_cell())
        except ValueError as error:
            raise BusError(f"The auctioneer describes an invalid cell: {error}") from error

    async def file(self, request: Request) -> Response:
        """A file of the page."""
        return self.response(request, str(request.url.path).removeprefix("/page/"))

    def response(self, request: Request, name: str = PAGE) -> Response:
        """The page, or one of its files; compressed if the request accepts that."""
        kind = f"{TYPES[name.rpartition('.')[2]]}; charset=utf-8"
        if "gzip" in request.headers.get("accept-encoding", ""):
            return Response(self.contents[name], media_type=kind, headers={**HEADERS, "Content-Encoding": "gzip"})
        return Response(gzip.decompress(self.contents[name]), media_type=kind, headers=HEADERS)

    @cached_property
    def contents(self) -> Mapping[str, bytes]:
        """The page and its files by name, compressed."""
        from scenarios.show.page import three_js
        from scenarios.table import static

        texts = {name: static(name) for name in (PAGE, *FILES)}
        texts["three.js"] = three_js()
        return {name: gzip.compress(text.encode(), mtime=0) for name, text in texts.items()}


def wants_page(scope: Scope) -> bool:
    """Whether a browser asks for the page: at `/`, and it accepts HTML."""
    return scope["path"] == "/" and b"text/html" in dict(scope["headers"]).get(b"accept", b"")


def is_public(scope: Scope) -> bool:
    """Whether a request is for the page or one of its files."""
    return scope["method"] in ("GET", "HEAD") and (wants_page(scope) or scope["path"].startswith("/page/"))


def _model_of(cell: Cell) -> Mapping[str, Any]:
    from scenarios.live.cell import described_model  # loads MuJoCo

    return {**described_model(cell, [arm.name for arm in cell.arms]), "heat": heat_scale(cell.warning_c, cell.error_c)}


Body = TypeVar("Body", bound=PersonRequest)
Asked = TypeVar("Asked", bound=msgspec.Struct)
Reply = TypeVar("Reply")
Endpoint = Callable[[Request], Awaitable[Response]]
NO_TOKENS: Mapping[str, Role] = {}


def check_token(token: str, where: str = "") -> str:
    """Return the token.

    Args:
        where: Begin of the error.

    Raises:
        FleetError: it is too short, or has other characters than printable ASCII.
    """
    if len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable():
        raise FleetError(f"{where}A token needs {MIN_TOKEN} or more printable ASCII characters (got {len(token)}).")
    return token


def read_tokens(path: Path) -> dict[str, Role]:
    """Roles by token, of a file with `ROLE TOKEN` in each line.

    Raises:
        FleetError: it cannot be read, others may read it, or a line is wrong.
    """
    try:
        if path.stat().st_mode & 0o077:
            raise FleetError(f"Other users can read the tokens in '{path}'. Run: chmod 600 {path}")
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FleetError(f"Cannot read the tokens in '{path}': {error}.") from error
    tokens: dict[str, Role] = {}
    first = dict[str, int]()
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        name, *rest = line.split(maxsplit=1)
        role: Role | None = next((role for role in ROLES if role == name), None)
        if role is None:
            raise FleetError(f"{path}, line {number}: no role '{name}'{nearest(name, ROLES)}")
        token = check_token("".join(rest).strip(), f"{path}, line {number}: ")
        if token in tokens:
            raise FleetError(
                f"{path}, lines {first[token]} and {number}: the same token. Write a token in one line only."
            )
        tokens[token], first[token] = role, number
    if not tokens:
        raise FleetError(f"'{path}' has no tokens. Write ROLE TOKEN in each line; roles: {', '.join(ROLES)}.")
    return tokens


class AccessCheck:
    """Passes requests with a token, at a limited rate; without tokens, requests to the local names of this machine.

    The host name is checked because a page of another site could otherwise send requests under its own host name (DNS
    rebinding). Requests for the page and its files need no token.
    """

    def __init__(self, app: ASGIApp, tokens: Mapping[str, Role], page: bool) -> None:
        self.app, self.tokens, self.page = app, {token.encode(): role for token, role in tokens.items()}, page
        self._senders: dict[bytes, tuple[float, float]] = {}
        """Remaining requests of each sender, and the loop time of that count."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request or pass it on, with its role."""
        refusal = None
        if scope["type"] == "http":
            headers, public = dict(scope["headers"]), self.page and is_public(scope)
            refusal = None if self.tokens and public else self.refusal(headers)
            if refusal is None and not public:  # a link to the page may be anywhere
                refusal = refuse_origin(headers)
            if refusal is None:
                shown = headers.get(b"authorization", b"")[7:]
                scope["role"] = self.tokens.get(shown, "monitor" if self.tokens else "operator")
                sender = shown if shown in self.tokens else str((scope.get("client") or ("",))[0]).encode()
                refusal = self._too_fast(sender)
        await (refusal or self.app)(scope, receive, send)

    def refusal(self, headers: dict[bytes, bytes]) -> Response | None:
        """Error response, None if the request may pass."""
        if not self.tokens:
            name = host_name(headers.get(b"host", b"").decode("latin-1"))
            if name in LOCAL:
                return None
            return problem_response(HTTPStatus.MISDIRECTED_REQUEST, f"This gateway is {LOCAL[0]}, not '{name}'.")
        shown = headers.get(b"authorization", b"")
        if shown[:7].lower() == b"bearer " and any([hmac.compare_digest(shown[7:], token) for token in self.tokens]):
            return None
        needed = "This gateway needs a token: Authorization: Bearer …."
        detail = "This token is not valid." if shown[:7].lower() == b"bearer " else needed
        return problem_response(HTTPStatus.UNAUTHORIZED, detail, {"WWW-Authenticate": "Bearer"})

    def _too_fast(self, sender: bytes) -> Response | None:
        now_s = asyncio.get_running_loop().time()
        left, counted_s = self._senders.pop(sender, (BURST, now_s))
        left = min(BURST, left + RATE_HZ * (now_s - counted_s))
        self._senders[sender] = max(0.0, left - 1.0), now_s
        if len(self._senders) > MAX_SENDERS:
            del self._senders[next(iter(self._senders))]
        if left >= 1.0:
            return None
        detail = f"More than {RATE_HZ:g} requests a second."
        return problem_response(HTTPStatus.TOO_MANY_REQUESTS, detail, {"Retry-After": str(math.ceil(1 / RATE_HZ))})


def host_name(host: str) -> str:
    """The name in `NAME:PORT`, or in `NAME`."""
    return host if host.endswith("]") else host.rpartition(":")[0] or host


def refuse_origin(headers: Mapping[bytes, bytes]) -> Response | None:
    """Error response to a request of a web page of another host; None for programs and for the page of this host.

    A proxy may change the host of a request: what the browser itself states in `Sec-Fetch-Site` comes first.
    """
    host, origin, site = (headers.get(name, b"").decode("latin-1") for name in (b"host", b"origin", b"sec-fetch-site"))
    name = host_name(origin.partition("://")[2])  # "" of the origin null
    is_own = site == "same-origin" or not origin or (bool(name) and name in (host_name(host), *LOCAL))
    if site != "cross-site" and is_own:
        return None
    given = printable(origin) if origin else f"Sec-Fetch-Site: {site}"
    return problem_response(HTTPStatus.FORBIDDEN, f"Web pages of other hosts may send no requests (got '{given}').")


def problem_response(status: HTTPStatus, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """Problem details, RFC 9457."""
    fields = {"type": "about:blank", "title": status.phrase, "status": status.value, "detail": detail}
    return Response(msgspec.json.encode(fields), status.value, headers, media_type="application/problem+json")


class AskBody(PersonRequest, frozen=True):
    """Body of /v4/ask: jobs for quotes."""

    jobs: tuple[JobSpec, ...]


class AcknowledgeBody(PersonRequest, frozen=True):
    """Body of /v4/alarms: a person has seen an alarm."""

    alarm: str
    by: Annotated[Person, msgspec.Meta(min_length=1)]
    """Who has seen it."""


class ResetBody(PersonRequest, frozen=True):
    """Body of /v4/reset: clear the fault of an arm."""

    arm: str
    by: Person = ""
    """Who requests it."""


@dataclass(eq=False)
class Readers:
    """All readers of the event stream; used on the event loop only."""

    connected: set[asyncio.Event] = field(default_factory=set[asyncio.Event])
    """Each reader waits for its event."""
    closed: bool = False

    def wake(self) -> None:
        """Have every reader look for new entries."""
        for reader in self.connected:
            reader.set()

    def close(self) -> None:
        """End every stream."""
        self.closed = True
        self.wake()


def application(
    bridge: AsyncBridge,
    readers: Readers,
    *,
    tokens: Mapping[str, Role] = NO_TOKENS,
    page: LivePage | None = None,
) -> Starlette:
    """Make the application; with tokens every request must show one, without any only local requests are served.

    Args:
        page: Shown to browsers at `/`; None for none.
    """
    boot = secrets.token_hex(4)  # event numbers are valid for one start of the gateway
    slots, shown = asyncio.Semaphore(MAX_REQUESTS), page or LivePage()

    async def limited(request: Callable[[], Awaitable[Reply]]) -> Reply:
        if slots.locked():
            raise HTTPException(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_REQUESTS} requests are waiting; try again.", RETRY
            )
        async with slots:
            return await request()

    async def fleet(request: Request) -> Response:
        text = request.query_params.get("jobs", str(MAX_JOBS))
        if not (text.isdecimal() and len(text) < 6 and int(text) <= MAX_JOBS):
            detail = f"?jobs=N is the number of jobs to list, 0..{MAX_JOBS} (got '{text[:64]}')."
            raise HTTPException(HTTPStatus.UNPROCESSABLE_ENTITY, detail)
        return json_response(await bridge.snapshot(int(text)))

    async def ask(key: str, message: msgspec.Struct, kind: type[Asked]) -> Asked:
        return await limited(lambda: bridge.ask(key, message, kind))

    def of_jobs(topic: str, kind: type[Body], reply: type[msgspec.Struct]) -> Endpoint:
        """Passes the body of a request on to the auctioneer."""

        async def post(request: Request) -> Response:
            message = await read_body(request, kind)
            return json_response(await ask(keys.of_jobs(bridge.fleet, topic), message, reply))

        return post

    submit_json = of_jobs("submit", Submission, SubmissionReply)

    async def submit(request: Request) -> Response:
        if content_type(request) == TABLE:
            return await submit_table(request)
        if request.query_params:
            raise MalformedMessage(f"Parameters are for a table ({TABLE}); a Submission has the field `by`.")
        return await submit_json(request)

    async def submit_table(request: Request) -> Response:
        content = await read_bytes(request, MAX_TABLE_BYTES)
        begin, by = (request.query_params.get(key, "") for key in ("shift_begin", "by"))
        check_request(Submission((), by))
        places, reply = None, SubmissionReply("", ())
        with suppress(Refused, BusError):  # no participant knows the cell
            places = [place.name for place in (await ask_cell()).places]
        read = partial(read_job_table, begin=shift_begin(begin, "shift_begin"), places=places)
        table = await limited(lambda: asyncio.to_thread(read, content, "The table"))
        rows = {job.name: (f"row {number}", job) for number, job in table.items()}
        try:
            for jobs in batches(tuple(table.values())):
                new = await ask(keys.of_jobs(bridge.fleet, "submit"), Submission(jobs, by), SubmissionReply)
                reply = replace(new, jobs=(*reply.jobs, *(with_cell(each, rows) for each in new.jobs)))
        except (BusError, Refused) as error:
            accepted = ", ".join(rows[each.job][0] for each in reply.jobs if each.accepted)
            kind = type(error) if isinstance(error, Refused) else BusError
            raise kind(f"{error} Accepted before: {accepted or 'no job'}.") from error
        order = {name: number for number, name in enumerate(rows)}
        return json_response(replace(reply, jobs=tuple(sorted(reply.jobs, key=lambda each: order[each.job]))))

    control = of_jobs("control", ControlRequest, Controlled)
    clear = of_jobs("clear", ClearRequest, Cleared)

    async def get_jobs(request: Request) -> Response:
        names = request.query_params.getlist("job")
        if wrong := [name for name in names if not is_name(name, of_job=True)]:
            raise MalformedMessage(f"?job=NAME must have {JOB_RULE} (got '{printable(wrong[0])}').")
        if (size := len(encode(StatusRequest(tuple(names))))) > MAX_BYTES:
            given = f"The names of {len(names)} jobs have {size:,} bytes, and at most {MAX_BYTES:,} are allowed."
            raise MalformedMessage(f"{given} Ask for fewer jobs at a time, or for all, without a name.")
        return json_response(await limited(lambda: bridge.statuses(names)))

    async def post_reset(request: Request) -> Response:
        body = await read_body(request, ResetBody)
        if not is_name(body.arm):
            raise HTTPException(HTTPStatus.UNPROCESSABLE_ENTITY, f"The name of an arm must have {NAME_RULE}.")
        is_present = {arm.arm: arm.present for arm in (await bridge.snapshot(0)).arms}
        if body.arm not in is_present:
            raise HTTPException(HTTPStatus.NOT_FOUND, f"There is no arm '{body.arm}'. Arms: {listed(is_present)}.")
        key = keys.of_arm(bridge.fleet, body.arm, "reset")
        try:
            return json_response(await ask(key, ResetRequest(body.by), ResetReply))
        except NoReply as error:
            if is_present[body.arm] and not error.late:
                raise Refused(without_reset(body.arm)) from error
            raise

    async def metrics(request: Request) -> Response:
        fleet = await bridge.snapshot()
        lasting = (alarm for alarm in fleet.alarms if alarm.ended_s is None)
        alarms = Counter((alarm.kind, "yes" if alarm.by else "no") for alarm in lasting)
        return Response(exposition(fleet, alarms), media_type=CONTENT_TYPE, headers={"Cache-Control": "no-store"})

    async def get_alarms(request: Request) -> Response:
        return json_response((await bridge.snapshot(0)).alarms)

    async def post_alarm(request: Request) -> Response:
        body = await read_body(request, AcknowledgeBody)
        return json_response(await bridge.acknowledge(body.alarm, body.by))

    async def ask_cell() -> Cell:
        return await ask(keys.of_jobs(bridge.fleet, "cell"), CellRequest(), Cell)

    async def get_cell(request: Request) -> Response:
        return json_response(await ask_cell())

    async def get_scene(request: Request) -> Response:
        return json_response(await shown.scene(ask_cell))

    async def post_ask(request: Request) -> Response:
        body = await read_body(request, AskBody)
        quote_request = decode(QuoteRequest, encode(QuoteRequest("http", body.jobs, dry_run=True)))
        return json_response(await limited(lambda: bridge.quotes(quote_request)))

    async def events(request: Request) -> Response:
        if readers.closed or len(readers.connected) >= MAX_READERS:
            detail = f"{len(readers.connected)} readers are connected; try again later."
            raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, detail, RETRY)
        return EventStream(bridge.feed, readers, boot, request.headers.get("last-event-id", ""))

    async def contents(request: Request) -> Response:
        if page is not None and wants_page(request.scope):
            return page.response(request)
        entries = [{"method": m, "path": p, "role": role, "what": what} for m, p, role, _, what in table]
        return json_response({"gateway": "thermofleet", "role": request.scope["role"], "requests": entries})

    table: list[tuple[str, str, Role, Endpoint, str]] = [
        ("GET", "/", "monitor", contents, "This list."),
        ("GET", "/v4/fleet", "monitor", fleet, "Arms, jobs and messages, as `thermofleet bus watch --json`."),
        ("GET", "/v4/events", "monitor", events, "Every message as server-sent events."),
        ("GET", "/v4/jobs", "monitor", get_jobs, "Status of the jobs ?job=NAME, or of all."),
        ("POST", "/v4/jobs", "submitter", submit, "Submit jobs: a Submission, or a table as text/csv."),
        ("GET", "/v4/cell", "monitor", get_cell, "Places, arms, kinds of jobs and limits."),
        ("GET", "/v4/scene", "monitor", get_scene, "Arms, places and colours in three dimensions."),
        ("POST", "/v4/control", "operator", control, "Cancel, settle, change, pause, resume: a ControlRequest."),
        ("POST", "/v4/clear", "operator", clear, "Free the space of an offline arm: a ClearRequest."),
        ("POST", "/v4/reset", "operator", post_reset, 'Clear the fault of an arm: {"arm": …, "by": …}.'),
        ("GET", "/v4/alarms", "monitor", get_alarms, "Alarms that last, and the last of the others."),
        ("POST", "/v4/alarms", "operator", post_alarm, 'Acknowledge an alarm: {"alarm": …, "by": …}.'),
        ("GET", "/metrics", "monitor", metrics, "Figures in the text format of Prometheus."),
        ("POST", "/v4/ask", "submitter", post_ask, 'Quotes without submitting: {"jobs": […]}.'),
    ]
    handlers: dict[str, dict[str, Endpoint]] = {}
    for method, path, role, handle, _ in table:
        handlers.setdefault(path, {})[method] = _checked(role, handle, PARAMETERS.get((method, path), ()))
    routes = [Route(path, _by_method(each), methods=list(each)) for path, each in handlers.items()]
    if page is not None:
        routes += [Route(f"/page/{name}", page.file, methods=["GET"]) for name in (*FILES, "three.js")]
    errors = dict.fromkeys((BusError, Refused, ScenarioError, HTTPException, Exception), error_response)
    access = Middleware(AccessCheck, tokens=tokens, page=page is not None)
    return Starlette(routes=routes, exception_handlers=errors, middleware=[access])


class EventStream(StreamingResponse):
    """Server-sent events until the reader disconnects or falls behind, or the gateway stops."""

    def __init__(self, feed: EventFeed, readers: Readers, boot: str, last_event: str) -> None:
        super().__init__(self._text(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})
        self._feed, self._readers, self._boot, self._last_event = feed, readers, boot, last_event
        self._woken = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Write the stream."""

        async def send_in_time(message: Message) -> None:
            await asyncio.wait_for(send(message), STUCK_S)

        self._readers.connected.add(self._woken)
        try:
            await super().__call__(scope, receive, send_in_time)
        except TimeoutError:
            pass  # the reader is stuck: the server closes the connection of an unfinished stream
        finally:
            self._readers.connected.discard(self._woken)

    async def _text(self) -> AsyncIterator[str]:
        last_boot, _, number = self._last_event.partition("-")
        is_of_this_start = last_boot == self._boot and number.isdecimal() and len(number) < 20
        seen = int(number) if is_of_this_start else 0
        entries, gap = self._feed.since(seen)
        has_missed = self._last_event and (gap or not is_of_this_start)
        gap_text = "event: gap\ndata: {}\n\n" if has_missed else ""
        yield "retry: 1000\n\n" + gap_text + "".join(map(self._event, entries))
        seen = entries[-1].number if entries else seen
        while not self._readers.closed:
            try:
                await asyncio.wait_for(self._woken.wait(), HEARTBEAT_S)
            except TimeoutError:
                yield ": heartbeat\n\n"
                continue
            self._woken.clear()
            entries, gap = self._feed.since(seen)
            if gap:
                break  # it has missed events: it reconnects and receives `gap`
            if entries:
                seen = entries[-1].number
                yield "".join(map(self._event, entries))

    def _event(self, entry: FeedEntry) -> str:
        name = msgspec.json.encode(entry.name).decode()
        data = f'{{"name":{name},"message":{entry.data}}}'
        return f"id: {self._boot}-{entry.number}\nevent: {entry.topic}\ndata: {data}\n\n"


def _by_method(handlers: Mapping[str, Endpoint]) -> Endpoint:
    """The handler of all requests of a path."""

    async def handle(request: Request) -> Response:
        return await handlers["GET" if request.method == "HEAD" else request.method](request)

    return handle


def _checked(needed: Role, handle: Endpoint, parameters: Sequence[str]) -> Endpoint:
    """The handler of a request that needs a role, and may have these query parameters."""

    async def check(request: Request) -> Response:
        if unknown := [name for name in request.query_params if name not in parameters]:
            allowed = f"Parameters: {', '.join(parameters)}." if parameters else "It has none."
            detail = f"There is no parameter '{unknown[0][:64]}' of this request. {allowed}"
            raise HTTPException(HTTPStatus.UNPROCESSABLE_ENTITY, detail)
        role: Role = request.scope["role"]
        if ROLES.index(role) < ROLES.index(needed):
            raise HTTPException(HTTPStatus.FORBIDDEN, f"This token has the role {role}; this request needs {needed}.")
        return await handle(request)

    return check


async def read_body(request: Request, kind: type[Body]) -> Body:
    """Read the message that is the body of a request.

    Raises:
        HTTPException: not JSON in UTF-8, compressed, too large or too slow, or a field occurs twice.
        MalformedMessage: not a message of this kind.
    """
    if (given := content_type(request)) != "application/json":
        detail = f"The body must be application/json, or for /v4/jobs also {TABLE} (got '{given}')."
        raise HTTPException(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, detail)
    _, _, charset = request.headers["content-type"].lower().partition("charset=")
    charset = charset.partition(";")[0].strip(' "')
    if charset not in ("", "utf-8", "utf8"):
        detail = f"JSON must be UTF-8 (got charset '{printable(charset)}')."
        raise HTTPException(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, detail)
    content = await read_bytes(request, MAX_BYTES)
    message = decode(kind, content)
    check_request(message)
    try:
        json.loads(content, object_pairs_hook=_check_fields, parse_int=str)  # `decode` takes the last of equal fields
    except (ValueError, RecursionError) as error:  # in fields that `decode` ignores
        raise MalformedMessage(f"Not JSON: {error}.") from error
    return message


def _check_fields(fields: Sequence[tuple[str, object]]) -> None:
    """Raise an HTTPException if an object has a field twice."""
    counts = Counter(name for name, _ in fields)
    if twice := [name for name, count in counts.items() if count > 1]:
        detail = f"An object has the field '{printable(twice[0])}' twice."
        raise HTTPException(HTTPStatus.UNPROCESSABLE_ENTITY, detail)


def content_type(request: Request) -> str:
    """Kind of the body of a request, without parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def read_bytes(request: Request, most: int) -> bytes:
    """Read a body of at most `most` bytes; raises an HTTPException if it is compressed, too large or too slow."""
    if (coding := request.headers.get("content-encoding", "identity").lower()) != "identity":
        detail = f"The body must not be compressed (got Content-Encoding '{printable(coding)}')."
        raise HTTPException(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, detail)
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for part in request.stream():
                content += part
                if len(content) > most:
                    detail = f"A body has at most {most} bytes; send several requests."
                    raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)
    except TimeoutError as error:
        raise HTTPException(HTTPStatus.REQUEST_TIMEOUT, f"The body did not arrive within {BODY_S:g} s.") from error
    except ClientDisconnect as error:
        raise HTTPException(HTTPStatus.BAD_REQUEST, "The body is incomplete.") from error
    return bytes(content)


def json_response(value: object) -> Response:
    """Response with a value as JSON."""
    return Response(msgspec.json.encode(value), media_type="application/json", headers={"Cache-Control": "no-store"})


def error_response(_: Request, error: Exception) -> Response:
    """Problem details of an error."""
    match error:
        case ScenarioError() | MalformedMessage():
            return problem_response(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        case Refused(temporary=False):
            return problem_response(HTTPStatus.CONFLICT, str(error))
        case BusError() | Refused():
            return problem_response(HTTPStatus.SERVICE_UNAVAILABLE, str(error), RETRY)
        case HTTPException():
            return problem_response(HTTPStatus(error.status_code), str(error.detail), error.headers)
        case _:
            return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, "The gateway failed; the reason is in its log.")


def scene_of(scenario: Scenario) -> dict[str, Any]:  # values of JSON
    """The cell of a scenario as the page draws it."""
    from fleet.arm.cell import cell_model

    limits, robots = scenario.limits, [arm.robot() for arm in scenario.arms]
    heat = heat_scale(limits.warning_c, limits.error_c)
    return {**cell_model(robots, scenario.places, scenario.fixtures), "heat": heat}


def run_gateway(
    endpoint: str,
    fleet: str,
    port: int,
    host: str,
    token: str,
    tokens: Path | None,
    page: LivePage | None = None,
    recording: Path | None = None,
    webhooks: Sequence[str] = (),
) -> None:
    """Serve until a signal arrives; the arguments are the options of `thermofleet bus gateway`."""
    kept: Sequence[Alarm] = ()
    if recording is not None and any(recording.glob("alarms-*")):
        from scenarios.live.recording import alarms_of  # loads Arrow, 20 MB

        try:
            kept = alarms_of(recording)
        except FleetError as error:
            _LOG.error("The alarms of the recording are not continued: %s", error)
    hooks = webhooks_of(webhooks)
    roles = read_tokens(tokens) if tokens else {}
    if token and check_token(token) in roles:
        raise FleetError(f"--token ({TOKEN}) is also a token of '{tokens}'. Give another one, or leave it out.")
    check(host, endpoint, bool(roles or token))
    name = the_fleet(fleet, endpoint)
    permitted = permitted_role(name, participant_at(endpoint), roles)
    if token:
        roles[token] = permitted
    with listen(host, port) as bound:
        with until_stopped() as stop:
            link = BusClient(endpoint, name, stopped=stop.is_set).open()
        with link:
            warn_of_absence(name, endpoint)
            number = asyncio.run(serve(link, bound, roles, page, kept=kept, hooks=hooks))
    if number == signal.SIGINT:
        raise Interrupted("The gateway was interrupted.")


def permitted_role(fleet: str, participant: RosterEntry | None, tokens: Mapping[str, Role]) -> Role:
    """Highest role whose requests the certificate of the gateway permits; operator without a certificate.

    Raises:
        FleetError: it is lower than the role of a token, or the certificate permits not even the requests of a monitor.
    """
    if participant is None:
        return "operator"
    needed = max(tokens.values(), key=ROLES.index, default=ROLES[0])
    rights = rights_by_role(fleet, participant.name)
    queries = {role: set(rights[role].queries) for role in ROLES}
    roles: list[Role] = [role for role in ROLES if queries[role] <= set(rights[participant.role].queries)]
    if needed not in roles:
        allowed = " or ".join(role for role in ROLES if queries[needed] <= queries[role])
        remedy = f"or give no token of a role above {roles[-1]}" if roles else "as --endpoint tls/HOST:PORT#DIR/NAME"
        raise FleetError(
            f"The certificate '{participant.common_name}' does not permit the requests of a token of the role "
            f"{needed}. Use a certificate of the role {allowed}, {remedy}."
        )
    return roles[-1]


def check(host: str, endpoint: str, has_tokens: bool) -> None:
    """Require a token from users who could not reach the router themselves.

    Raises:
        FleetError: an option is wrong or missing.
    """
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError as error:
        raise FleetError(f"--host must be an IP address, as 127.0.0.1 or ::1 (got '{host}').") from error
    if not has_tokens and endpoint.startswith("tls/"):
        raise FleetError(
            f"The router needs certificates, and without a token every user of this machine could use yours. Set "
            f"{TOKEN} (or --token) to {MIN_TOKEN} or more random characters, or give --tokens."
        )
    if local:
        return
    if not has_tokens:
        raise FleetError(
            f"--host {host} is reachable from other machines, which could submit jobs. Set {TOKEN} (or --token) to "
            f"{MIN_TOKEN} or more random characters, or use 127.0.0.1."
        )
    _LOG.warning("Listening on %s: HTTP is not encrypted and shows the token; put TLS in front.", host)


def listen(host: str, port: int) -> socket.socket:
    """Listening socket; the system closes connections whose reader receives nothing for `STUCK_S`.

    Raises:
        FleetError: the address is not of this machine, or the port is in use.
    """
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        bound.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * STUCK_S))
    try:
        bound.bind((host, port))
        bound.listen()
    except OSError as error:
        bound.close()
        raise FleetError(f"The gateway cannot listen on {host}:{port}: {os.strerror(error.errno or 0)}.") from error
    return bound


class Server(uvicorn.Server):
    """Server that leaves signals to its caller, and ends the event streams when it stops."""

    def __init__(self, app: Starlette, readers: Readers) -> None:
        config = uvicorn.Config(
            app,
            http=_protocol(),
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            limit_concurrency=MAX_CONNECTIONS,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=2,
        )
        super().__init__(config)
        self._readers = readers

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Do nothing: uvicorn would raise SIGTERM again when it stops."""
        yield

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the event streams, and shut down."""
        self._readers.close()
        await super().shutdown(sockets)


def _protocol() -> type[H11Protocol]:
    """HTTP protocol that closes connections without a complete request."""
    waiting: dict[H11Protocol, Callable[[], None]] = {}

    class Protocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:
            super().connection_made(transport)
            waiting[self] = self._end_waiting
            if len(waiting) > MAX_WAITING:
                next(iter(waiting.values()))()
            self.loop.call_later(HEADER_S, self._end_waiting)

        def handle_events(self) -> None:
            super().handle_events()
            if self.cycle is not None:
                waiting.pop(self, None)

        def connection_lost(self, exc: Exception | None) -> None:
            waiting.pop(self, None)
            super().connection_lost(exc)

        def _end_waiting(self) -> None:
            if self in waiting:
                del waiting[self]
                self.transport.close()

    return Protocol


async def serve(
    link: BusClient,
    bound: socket.socket,
    tokens: Mapping[str, Role],
    page: LivePage | None = None,
    *,
    kept: Sequence[Alarm] = (),
    hooks: Sequence[Webhook] = (),
) -> int:
    """Serve until a signal arrives; return its number.

    Args:
        kept: Alarms of a recording.
        hooks: Targets of new alarms.
    """
    readers, received = Readers(), [0]

    def tell(alarm: Alarm) -> None:
        for hook in hooks:
            hook.send(alarm)

    def check_hooks() -> list[Finding]:
        return [finding for hook in hooks for finding in hook.findings()]

    address, bound_port, *_ = bound.getsockname()
    monitor = f"{MONITOR}-{bound_port}"  # without certificates all gateways of a fleet are on one machine
    bridge = AsyncBridge(link, readers.wake, monitor=monitor, kept=kept, on_alarm=tell, more_findings=check_hooks)
    async with bridge, AsyncExitStack() as running:
        for hook in hooks:
            running.callback(asyncio.create_task(hook.run()).cancel)
        server = Server(application(bridge, readers, tokens=tokens, page=page), readers)

        def stop(number: int) -> None:
            received[0], server.should_exit = number, True

        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stop, number)
        shown = f"[{address}]" if ":" in address else address
        kind, path = ("gateway", "/v4") if page is None else ("page", "/")
        return_memory()
        echo(f"ready {kind} http://{shown}:{bound_port}{path} {os.getpid()}")
        await server.serve(sockets=[bound])
    return received[0]
