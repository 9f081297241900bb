"""Who may do what over HTTP: tokens with roles, request rates, and unfinished bodies."""

import asyncio
import hmac
import math
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Literal, get_args

import msgspec
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from fleet.errors import FleetError, nearest

Role = Literal["monitor", "submitter", "operator"]
ROLES: tuple[Role, ...] = get_args(Role)
"""Each role may do what the ones before it may."""
MIN_TOKEN = 16
MAX_BODIES = 32
"""Unfinished bodies at a time; one more ends the oldest."""
RATE_HZ, BURST = 50.0, 100.0
"""Requests per real second of one token, or without tokens of one address; and how many at once after a pause."""
MAX_SENDERS = 4096
"""Tokens and addresses whose rate is kept."""
LOCAL = ("127.0.0.1", "localhost", "[::1]")


class Problem(Exception):
    """An HTTP error with a sentence that says what is wrong."""

    def __init__(self, status: HTTPStatus, detail: str) -> None:
        super().__init__(detail)
        self.status, self.detail = status, detail


def check_token(token: str) -> str:
    """Return the token.

    Raises:
        FleetError: it is too short, or has other characters than printable ASCII.
    """
    if len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable():
        raise FleetError(f"A token needs {MIN_TOKEN} or more printable ASCII characters (got {len(token)}).")
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
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        name, _, token = line.strip().partition(" ")
        role: Role | None = next((role for role in ROLES if role == name), None)
        if role is None:
            raise FleetError(f"{path}, line {number}: no role '{name}'{nearest(name, ROLES)}")
        tokens[check_token(token.strip())] = role
    if not tokens:
        raise FleetError(f"'{path}' holds no tokens; a line is ROLE TOKEN. Roles: {', '.join(ROLES)}.")
    return tokens


class AccessCheck:
    """Passes requests that show a token, at a limited rate; without tokens, requests to this machine's local names.

    The name is checked since a page of another site must not reach the gateway under a name of its own. A request that
    is `public` needs no token.
    """

    def __init__(
        self, app: ASGIApp, tokens: Mapping[str, Role], public: Callable[[Scope], bool] = lambda scope: False
    ) -> None:
        self.app, self.tokens, self.public = app, {token.encode(): role for token, role in tokens.items()}, public
        self._senders: dict[bytes, tuple[float, float]] = {}
        """Requests that each may still send, and the loop's time at which that was counted."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request or pass it on, with its role."""
        refusal = None
        if scope["type"] == "http":
            headers = dict(scope["headers"])
            refusal = None if self.tokens and self.public(scope) else self.refusal(headers)
            if refusal is None:
                shown = headers.get(b"authorization", b"")[7:]
                scope["role"] = self.tokens.get(shown, "monitor" if self.tokens else "operator")
                sender = shown if shown in self.tokens else str((scope.get("client") or ("",))[0]).encode()
                refusal = self._too_fast(sender)
        await (refusal or self.app)(scope, receive, send)

    def refusal(self, headers: dict[bytes, bytes]) -> Response | None:
        """Error response, None if the request may pass."""
        if not self.tokens:
            host = headers.get(b"host", b"").decode("latin-1")
            name = host if host.endswith("]") else host.rpartition(":")[0] or host
            if name in LOCAL:
                return None
            return problem_response(HTTPStatus.MISDIRECTED_REQUEST, f"This gateway is {LOCAL[0]}, not '{name}'.")
        shown = headers.get(b"authorization", b"")
        if shown[:7].lower() == b"bearer " and any([hmac.compare_digest(shown[7:], token) for token in self.tokens]):
            return None
        detail = "This gateway needs a token: Authorization: Bearer …."
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


def check_role(request: Request, needed: Role) -> None:
    """Check the role of a request's token.

    Raises:
        Problem: it may not do this.
    """
    role: Role = request.scope["role"]
    if ROLES.index(role) < ROLES.index(needed):
        raise Problem(HTTPStatus.FORBIDDEN, f"This token has the role {role}; this request needs {needed}.")


class Bodies:
    """Limits the time and the number of unfinished bodies: who sends quickly is not held up by those who do not."""

    def __init__(self, body_s: float) -> None:
        self.body_s = body_s
        self._unfinished: dict[asyncio.Timeout, None] = {}

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[None]:
        """Within it one body is read.

        Raises:
            TimeoutError: it took too long, or too many newer ones arrived meanwhile.
        """
        async with asyncio.timeout(self.body_s) as limit:
            self._unfinished[limit] = None
            if len(self._unfinished) > MAX_BODIES:
                oldest = next(iter(self._unfinished))
                del self._unfinished[oldest]
                oldest.reschedule(asyncio.get_running_loop().time())
            try:
                yield
            finally:
                self._unfinished.pop(limit, None)


def problem_response(status: HTTPStatus, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """Problem details, RFC 9457."""
    fields = {"type": "about:blank", "title": status.phrase, "status": status.value, "detail": detail}
    return Response(msgspec.json.encode(fields), status.value, headers, media_type="application/problem+json")
