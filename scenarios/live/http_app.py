"""The bus over HTTP: the fleet as JSON, messages as server-sent events, job submissions and quotes.

The bus is served on a thread of its own (`fleet.live.monitor.async_bridge`); feed and reader buffers are used on the
event loop only. Errors are problem details (RFC 9457).
"""

import asyncio
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Message, Receive, Scope, Send

from fleet.bus.protocol.auction import JobSpec, QuoteRequest, StatusRequest, Submission
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.messages import MalformedMessage, decode, encode
from fleet.bus.protocol.operator import (
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Person,
    ResetReply,
    ResetRequest,
)
from fleet.errors import NAME_RULE, is_name
from fleet.live.monitor.async_bridge import AsyncBridge, NoReply
from fleet.live.monitor.event_feed import Entry, EventFeed, ReaderBuffer
from fleet.live.monitor.snapshot import MAX_JOBS
from scenarios.live.http_access import AccessCheck, Bodies, Problem, Role, check_role, problem_response
from scenarios.live.http_page import FILES, LivePage, is_public, wants_page

MAX_BYTES = 60_000
"""Of a body: what the router passes, less the overhead of a message."""
MAX_READERS, MAX_REQUESTS = 64, 16
BODY_S, STUCK_S, HEARTBEAT_S = 10.0, 10.0, 15.0
"""Real seconds: for a body to arrive; for a reader to take what was sent; between two heartbeats."""
Body = TypeVar("Body", bound=msgspec.Struct)
Reply = TypeVar("Reply")
Endpoint = Callable[[Request], Awaitable[Response]]
NO_TOKENS: Mapping[str, Role] = {}


class AskBody(msgspec.Struct, frozen=True):
    """Body of /v4/ask: jobs to be quoted, not done."""

    jobs: tuple[JobSpec, ...]


class ResetBody(msgspec.Struct, frozen=True):
    """Body of /v4/reset: clear the fault of an arm."""

    arm: str
    by: Person = ""
    """Who requests it."""


@dataclass(eq=False)
class Reader(ReaderBuffer):
    """One reader of the event stream."""

    wake: asyncio.Event = field(default_factory=asyncio.Event)


@dataclass(eq=False)
class Readers:
    """All readers of the event stream; used on the event loop only."""

    connected: set[Reader] = field(default_factory=set[Reader])
    closed: bool = False

    def put(self, entry: Entry) -> None:
        """Pass an entry to every reader."""
        for reader in self.connected:
            reader.put(entry)
            reader.wake.set()

    def close(self) -> None:
        """End every stream."""
        self.closed = True
        for reader in self.connected:
            reader.wake.set()


def application(
    bridge: AsyncBridge,
    readers: Readers,
    *,
    tokens: Mapping[str, Role] = NO_TOKENS,
    heartbeat_s: float = HEARTBEAT_S,
    stuck_s: float = STUCK_S,
    body_s: float = BODY_S,
    page: LivePage | None = None,
) -> Starlette:
    """Make the application; with tokens every request must show one, without any only local requests are served.

    Args:
        page: Shown to browsers at `/`; None for none.
    """
    boot = secrets.token_hex(4)  # event numbers are valid for one start of the gateway
    slots, bodies, shown = asyncio.Semaphore(MAX_REQUESTS), Bodies(body_s), page or LivePage()

    async def limited(request: Callable[[], Awaitable[Reply]]) -> Reply:
        if slots.locked():
            raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_REQUESTS} requests are waiting; try again.")
        async with slots:
            return await request()

    async def fleet(request: Request) -> Response:
        text = request.query_params.get("jobs", "")
        jobs = int(text) if text.isdecimal() and len(text) < 5 else MAX_JOBS
        return json_response(await bridge.snapshot(jobs))

    async def post_jobs(request: Request) -> Response:
        submission = await read_body(request, Submission, bodies)
        return json_response(await limited(lambda: bridge.submit(submission)))

    async def get_jobs(request: Request) -> Response:
        names = tuple(request.query_params.getlist("job"))
        return json_response(await limited(lambda: bridge.status(StatusRequest(names))))

    async def post_control(request: Request) -> Response:
        control = await read_body(request, ControlRequest, bodies)
        return json_response(await limited(lambda: bridge.request("control", control, Controlled)))

    async def post_clear(request: Request) -> Response:
        clear = await read_body(request, ClearRequest, bodies)
        return json_response(await limited(lambda: bridge.request("clear", clear, Cleared)))

    async def post_reset(request: Request) -> Response:
        body = await read_body(request, ResetBody, bodies)
        if not is_name(body.arm):
            raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"The name of an arm must have {NAME_RULE}.")
        return json_response(
            await limited(lambda: bridge.request_of_arm(body.arm, "reset", ResetRequest(body.by), ResetReply))
        )

    async def ask_cell() -> Cell:
        return await limited(lambda: bridge.request("cell", CellRequest(), Cell))

    async def get_cell(request: Request) -> Response:
        return json_response(await ask_cell())

    async def get_scene(request: Request) -> Response:
        return json_response(await shown.scene(ask_cell))

    async def post_ask(request: Request) -> Response:
        ask = await read_body(request, AskBody, bodies)
        try:
            quote_request = decode(QuoteRequest, encode(QuoteRequest("http", ask.jobs, dry_run=True)))
        except MalformedMessage as error:
            raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from error
        return json_response(await limited(lambda: bridge.quotes(quote_request)))

    async def events(request: Request) -> Response:
        if readers.closed or len(readers.connected) >= MAX_READERS:
            detail = f"{len(readers.connected)} readers are connected; try again later."
            raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, detail)
        last_event = request.headers.get("last-event-id", "")
        return EventStream(bridge.feed, readers, boot, last_event, heartbeat_s, stuck_s)

    async def contents(request: Request) -> Response:
        if page is not None and wants_page(request.scope):
            return page.response()
        entries = [{"method": m, "path": p, "role": role, "what": what} for m, p, role, _, what in table]
        return json_response({"gateway": "thermofleet", "role": request.scope["role"], "requests": entries})

    table: list[tuple[str, str, Role, Endpoint, str]] = [
        ("GET", "/", "monitor", contents, "This list."),
        (
            "GET",
            "/v4/fleet",
            "monitor",
            fleet,
            "State of every arm, jobs and messages, as `thermofleet bus watch --json`.",
        ),
        ("GET", "/v4/events", "monitor", events, "Every message as server-sent events."),
        ("GET", "/v4/jobs", "monitor", get_jobs, "Status of the jobs ?job=NAME, or of all."),
        ("POST", "/v4/jobs", "submitter", post_jobs, "Submit jobs: a Submission."),
        ("GET", "/v4/cell", "monitor", get_cell, "Places, arms, kinds of jobs and limits: all that a job may name."),
        ("GET", "/v4/scene", "monitor", get_scene, "Arms, places and colours in three dimensions, as the page draws."),
        ("POST", "/v4/control", "operator", post_control, "Cancel, settle, change, pause, resume: a ControlRequest."),
        ("POST", "/v4/clear", "operator", post_clear, "Free the space of an absent arm: a ClearRequest."),
        ("POST", "/v4/reset", "operator", post_reset, 'Clear the fault of an arm: {"arm": …, "by": …}.'),
        ("POST", "/v4/ask", "submitter", post_ask, 'Quotes without submitting: {"jobs": […]}.'),
    ]
    routes = [Route(path, _checked(role, handle), methods=[method]) for method, path, role, handle, _ in table]
    if page is not None:
        routes += [Route(f"/page/{name}", page.file, methods=["GET"]) for name in (*FILES, "three.js")]
    handlers = dict.fromkeys((Problem, NoReply, HTTPException, Exception), error_response)
    access = Middleware(AccessCheck, tokens=tokens, **({"public": is_public} if page is not None else {}))
    return Starlette(routes=routes, exception_handlers=handlers, middleware=[access])


class EventStream(StreamingResponse):
    """Server-sent events until the reader disconnects or falls behind, or the gateway stops."""

    def __init__(
        self, feed: EventFeed, readers: Readers, boot: str, last_event: str, heartbeat_s: float, stuck_s: float
    ) -> None:
        super().__init__(self._text(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})
        self._feed, self._readers, self._boot, self._last_event = feed, readers, boot, last_event
        self._heartbeat_s, self._stuck_s, self._reader = heartbeat_s, stuck_s, Reader()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Write the stream."""

        async def send_in_time(message: Message) -> None:
            await asyncio.wait_for(send(message), self._stuck_s)

        self._readers.connected.add(self._reader)
        try:
            await super().__call__(scope, receive, send_in_time)
        except TimeoutError:
            pass  # the reader is stuck: the server closes the connection of an unfinished stream
        finally:
            self._readers.connected.discard(self._reader)

    async def _text(self) -> AsyncIterator[str]:
        reader = self._reader
        last_boot, _, number = self._last_event.partition("-")
        seen = int(number) if last_boot == self._boot and number.isdecimal() and len(number) < 20 else 0
        missed, gap = self._feed.since(seen)
        gap_text = "event: gap\ndata: {}\n\n" if gap and self._last_event else ""
        yield "retry: 1000\n\n" + gap_text + "".join(map(self._event, missed))
        seen = missed[-1].number if missed else 0
        while not (self._readers.closed or reader.full):
            try:
                await asyncio.wait_for(reader.wake.wait(), self._heartbeat_s)
            except TimeoutError:
                yield ": heartbeat\n\n"
                continue
            reader.wake.clear()
            entries = [entry for entry in reader.take() if entry.number > seen]
            if entries and not reader.full:
                yield "".join(map(self._event, entries))

    def _event(self, entry: Entry) -> str:
        name = msgspec.json.encode(entry.name).decode()
        data = f'{{"name":{name},"message":{entry.data}}}'
        return f"id: {self._boot}-{entry.number}\nevent: {entry.topic}\ndata: {data}\n\n"


def _checked(role: Role, handle: Endpoint) -> Endpoint:
    """The handler of a request that needs a role."""

    async def check(request: Request) -> Response:
        check_role(request, role)
        return await handle(request)

    return check


async def read_body(request: Request, kind: type[Body], bodies: Bodies) -> Body:
    """Read the message that is the body of a request.

    Raises:
        Problem: too large, too slow, not JSON, or not a message of this kind.
    """
    content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if content_type != "application/json":
        detail = f"The body must be application/json (got '{content_type}')."
        raise Problem(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, detail)
    parts: list[bytes] = []
    try:
        async with bodies.reading():
            async for part in request.stream():
                parts.append(part)
                if sum(map(len, parts)) > MAX_BYTES:
                    detail = f"A body has at most {MAX_BYTES} bytes; send several requests."
                    raise Problem(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, detail)
        return decode(kind, b"".join(parts))
    except TimeoutError as error:
        raise Problem(HTTPStatus.REQUEST_TIMEOUT, f"The body did not arrive within {bodies.body_s:g} s.") from error
    except ClientDisconnect as error:
        raise Problem(HTTPStatus.BAD_REQUEST, "The body is incomplete.") from error
    except MalformedMessage as error:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from error


def json_response(value: object) -> Response:
    """Response with a value as JSON."""
    return Response(msgspec.json.encode(value), media_type="application/json", headers={"Cache-Control": "no-store"})


def error_response(_: Request, error: Exception) -> Response:
    """Problem details of an error."""
    match error:
        case Problem():
            return problem_response(error.status, error.detail)
        case NoReply():
            return problem_response(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
        case HTTPException():
            return problem_response(HTTPStatus(error.status_code), str(error.detail), error.headers)
        case _:
            return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, "The gateway failed; the reason is in its log.")
