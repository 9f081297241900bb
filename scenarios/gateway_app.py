"""The bus over HTTP: the fleet as JSON, its words as server-sent events, jobs in and quotes out.

Zenoh runs on a thread of its own; what is heard crosses to the event loop, where the feed and the letter boxes live,
and what is asked crosses the other way. Errors are problem details (RFC 9457).
"""

import asyncio
import hmac
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from fleet.bus.messages import MalformedMessage, encode, read
from fleet.bus.trade import JobWord, QuoteRequest, Status, StatusRequest, Submission
from fleet.live.gateway import Gateway, Silence
from fleet.live.stream import Entry, Letterbox

MOST_BYTES = 60_000
"""Of a body: what the router lets through, less what is added on the way."""
MOST_READERS, MOST_QUESTIONS = 64, 16
BODY_S, STUCK_S, HEARTBEAT_S = 10.0, 10.0, 15.0
"""Real seconds: for a body to arrive; for a reader to take what it was sent; between two signs of life."""
LOCAL = ("127.0.0.1", "localhost", "[::1]")
Asked = TypeVar("Asked", bound=msgspec.Struct)


class Problem(Exception):
    """What is wrong with a request, in one sentence."""

    def __init__(self, status: HTTPStatus, detail: str) -> None:
        super().__init__(detail)
        self.status, self.detail = status, detail


class Ask(msgspec.Struct, frozen=True):
    """Body of /v1/ask: jobs that nobody is to do."""

    jobs: tuple[JobWord, ...]


@dataclass(eq=False)
class Reader:
    """One that reads the stream."""

    box: Letterbox = field(default_factory=Letterbox)
    woken: asyncio.Event = field(default_factory=asyncio.Event)


@dataclass(eq=False)
class Readers:
    """All that read the stream; lives on the event loop."""

    there: set[Reader] = field(default_factory=set[Reader])
    closed: bool = False

    def tell(self, entry: Entry) -> None:
        """A word for everybody."""
        for reader in self.there:
            reader.box.put(entry)
            reader.woken.set()

    def close(self) -> None:
        """End every stream."""
        self.closed = True
        for reader in self.there:
            reader.woken.set()


def application(
    gateway: Gateway,
    readers: Readers,
    *,
    token: str = "",
    heartbeat_s: float = HEARTBEAT_S,
    stuck_s: float = STUCK_S,
    body_s: float = BODY_S,
) -> Starlette:
    """The application; with a token only those who show it get in, without one only requests to this machine."""
    life = secrets.token_hex(4)  # numbers of another life of this gateway mean nothing to this one
    questions = asyncio.Semaphore(MOST_QUESTIONS)

    async def asked(question: Callable[[], Awaitable[Any]]) -> Any:
        if questions.locked():
            raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_QUESTIONS} questions wait already; try again.")
        async with questions:
            return await question()

    async def fleet(request: Request) -> Response:
        return json_of(await gateway.now())

    async def post_jobs(request: Request) -> Response:
        word = await body(request, Submission, body_s)
        return json_of(await asked(lambda: gateway.submit(word)))

    async def get_jobs(request: Request) -> Response:
        names = tuple(request.query_params.getlist("job"))
        status: Status = await asked(lambda: gateway.status(StatusRequest(names)))
        return json_of(status)

    async def post_ask(request: Request) -> Response:
        word = await body(request, Ask, body_s)
        try:
            question = read(QuoteRequest, encode(QuoteRequest("http", word.jobs, dry_run=True)))
        except MalformedMessage as error:
            raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from error
        return json_of(await asked(lambda: gateway.quotes(question)))

    async def events(request: Request) -> Response:
        if readers.closed or len(readers.there) >= MOST_READERS:
            raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, f"{len(readers.there)} read already; try again later.")
        last = request.headers.get("last-event-id", "")
        known_life, _, number = last.partition("-")
        seen = int(number) if known_life == life and number.isdecimal() and len(number) < 20 else 0
        return Stream(gateway, readers, life, seen, bool(last), heartbeat_s, stuck_s)

    routes = [
        Route("/v1/fleet", fleet),
        Route("/v1/events", events),
        Route("/v1/jobs", get_jobs),
        Route("/v1/jobs", post_jobs, methods=["POST"]),
        Route("/v1/ask", post_ask, methods=["POST"]),
    ]
    handlers: dict[Any, Callable[[Request, Any], Response]] = {
        Problem: lambda _, error: problem(error.status, error.detail),
        Silence: lambda _, error: problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error)),
        HTTPException: lambda _, error: problem(HTTPStatus(error.status_code), str(error.detail), error.headers),
        Exception: lambda _, error: problem(HTTPStatus.INTERNAL_SERVER_ERROR, "The gateway failed; its log says why."),
    }
    return Starlette(routes=routes, exception_handlers=handlers, middleware=[Middleware(Gatekeeper, token=token)])


class Gatekeeper:
    """Lets in who shows the token; without one, who means this machine: a page elsewhere must not reach it by name."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self.app, self.token = app, token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or hand on."""
        if scope["type"] == "http":
            refusal = self.refusal(dict(scope["headers"]))
            if refusal is not None:
                await refusal(scope, receive, send)
                return
        await self.app(scope, receive, send)

    def refusal(self, headers: dict[bytes, bytes]) -> Response | None:
        """Why not, if not."""
        if not self.token:
            host = headers.get(b"host", b"").decode("latin-1")
            name = host if host.endswith("]") else host.rpartition(":")[0] or host
            if name in LOCAL:
                return None
            return problem(HTTPStatus.MISDIRECTED_REQUEST, f"This gateway is {LOCAL[0]}, not '{name}'.")
        shown = headers.get(b"authorization", b"")
        if shown[:7].lower() == b"bearer " and hmac.compare_digest(shown[7:], self.token):
            return None
        detail = "This gateway wants its token: Authorization: Bearer …."
        return problem(HTTPStatus.UNAUTHORIZED, detail, {"WWW-Authenticate": "Bearer"})


class Stream(Response):
    """Server-sent events until the reader goes, falls behind, or the gateway ends."""

    def __init__(
        self,
        gateway: Gateway,
        readers: Readers,
        life: str,
        seen: int,
        back: bool,
        heartbeat_s: float,
        stuck_s: float,
    ) -> None:
        super().__init__(media_type="text/event-stream", headers={"Cache-Control": "no-store"})
        del self.headers["content-length"]
        self._gateway, self._readers, self._life, self._seen, self._back = gateway, readers, life, seen, back
        self._heartbeat_s, self._stuck_s = heartbeat_s, stuck_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Write the stream."""
        reader = Reader()
        self._readers.there.add(reader)
        gone = asyncio.ensure_future(disconnected(receive, reader))
        try:
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            missed, gap = self._gateway.feed.since(self._seen)
            text = "retry: 1000\n\n" + ("event: gap\ndata: {}\n\n" if gap and self._back else "")
            await self._send(send, text + "".join(map(self._event, missed)))
            seen = missed[-1].number if missed else 0
            while not (gone.done() or self._readers.closed or reader.box.full):
                try:
                    await asyncio.wait_for(reader.woken.wait(), self._heartbeat_s)
                except TimeoutError:
                    await self._send(send, ": still here\n\n")
                    continue
                reader.woken.clear()
                entries = [entry for entry in reader.box.take() if entry.number > seen]
                if entries and not reader.box.full:
                    await self._send(send, "".join(map(self._event, entries)))
            if not gone.done():
                await self._send(send, "", more=False)
        except TimeoutError:
            pass  # stuck: the server closes the connection of a stream without an end
        finally:
            self._readers.there.discard(reader)
            gone.cancel()

    def _event(self, entry: Entry) -> str:
        name = msgspec.json.encode(entry.name).decode()
        data = f'{{"name":{name},"word":{entry.data}}}'
        return f"id: {self._life}-{entry.number}\nevent: {entry.topic}\ndata: {data}\n\n"

    async def _send(self, send: Send, text: str, more: bool = True) -> None:
        message = {"type": "http.response.body", "body": text.encode(), "more_body": more}
        await asyncio.wait_for(send(message), self._stuck_s)


async def disconnected(receive: Receive, reader: Reader) -> None:
    """Ends when the reader has gone, and wakes its stream."""
    while (await receive())["type"] != "http.disconnect":
        pass
    reader.woken.set()


async def body(request: Request, kind: type[Asked], body_s: float) -> Asked:
    """The word that is the body of a request.

    Raises:
        Problem: too large, too slow, not JSON, or not such a word.
    """
    said = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if said != "application/json":
        raise Problem(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"The body must be application/json (got '{said}').")
    parts: list[bytes] = []
    try:
        async with asyncio.timeout(body_s):
            async for part in request.stream():
                parts.append(part)
                if sum(map(len, parts)) > MOST_BYTES:
                    raise Problem(
                        HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"A body has at most {MOST_BYTES} bytes; send several."
                    )
    except TimeoutError as error:
        raise Problem(HTTPStatus.REQUEST_TIMEOUT, f"The body did not arrive within {body_s:g} s.") from error
    except ClientDisconnect as error:
        raise Problem(HTTPStatus.BAD_REQUEST, "The body did not arrive whole.") from error
    try:
        return read(kind, b"".join(parts))
    except MalformedMessage as error:
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from error


def json_of(word: object) -> Response:
    """A word as a response."""
    return Response(msgspec.json.encode(word), media_type="application/json", headers={"Cache-Control": "no-store"})


def problem(status: HTTPStatus, detail: str, headers: Any = None) -> Response:
    """Problem details, RFC 9457."""
    told = {"type": "about:blank", "title": status.phrase, "status": status.value, "detail": detail}
    return Response(msgspec.json.encode(told), status.value, headers, media_type="application/problem+json")
