"""The live page: its files, as browsers load them, and the cell in three dimensions as it draws it.

Nobody needs a token for the files, which say nothing about a fleet; the page asks for one and sends it with each
request.
"""

import asyncio
import gzip
from collections.abc import Awaitable, Callable, Mapping
from functools import cached_property
from typing import Any  # values of JSON

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Scope

from fleet.bus.protocol.cell import Cell
from fleet.env.render.heat import heat_scale
from fleet.errors import BusError

PAGE = "dashboard.html"
FILES = ("page.css", "dashboard.css", "cell.js", "stream.js", "tables.js", "actions.js", "dashboard.js")
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "Content-Encoding": "gzip",
    "Cache-Control": "no-cache",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Vary": "Accept",
    "X-Content-Type-Options": "nosniff",
}


class LivePage:
    """The page of a gateway."""

    def __init__(self, model: Mapping[str, Any] | None = None) -> None:
        """Prepare; without a model the cell is drawn as the auctioneer describes it."""
        self._given, self._model = model is not None, model
        self._cell: Cell | None = None

    async def scene(self, ask_cell: Callable[[], Awaitable[Cell]]) -> Mapping[str, Any]:
        """The cell in three dimensions; raises BusError if nobody describes it, or with wrong numbers."""
        if self._given and self._model is not None:
            return self._model
        cell = await ask_cell()
        if self._model is None or cell != self._cell:
            try:
                self._model = await asyncio.to_thread(_model_of, cell)
            except ValueError as error:
                raise BusError(f"The auctioneer describes a cell that cannot be: {error}") from error
            self._cell = cell
        return self._model

    async def file(self, request: Request) -> Response:
        """A file of the page."""
        return self.response(str(request.url.path).removeprefix("/page/"))

    def response(self, name: str = PAGE) -> Response:
        """The page, or one of its files."""
        kind = f"{TYPES[name.rpartition('.')[2]]}; charset=utf-8"
        return Response(self.contents[name], media_type=kind, headers=HEADERS)

    @cached_property
    def contents(self) -> Mapping[str, bytes]:
        """The page and its files by name, compressed."""
        from scenarios.show.html import static
        from scenarios.show.replay import three_js

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
