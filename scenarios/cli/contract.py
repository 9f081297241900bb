"""`thermofleet contract`: schemas and AsyncAPI document of the bus, and the tables of bus.md, env.md and cli.md."""

import json
from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli.terminal import out_console, say

PAGES = ("bus.md", "cli.md", "env.md")
"""Pages with generated tables."""


def contract_command(
    out: Annotated[Path, typer.Option(help="Folder for the documents.")] = Path("docs/contract"),
    check: Annotated[bool, typer.Option("--check", help="Only check whether the documents are current.")] = False,
) -> None:
    """Write JSON schemas and AsyncAPI 3 document of all bus messages, and the tables of bus.md, cli.md and env.md."""
    made = documents(out)
    stale = [path for path, text in made.items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    if check:
        if stale:
            raise FleetError(f"Not current: {', '.join(map(str, stale))}. Run: thermofleet contract --out {out}")
        say(f"Current: {', '.join(map(str, made))}.", out_console)
        return
    out.mkdir(parents=True, exist_ok=True)
    for path in stale:
        path.write_text(made[path], encoding="utf-8")
    say(f"Written: {', '.join(map(str, stale))}." if stale else "All documents were current.", out_console)


def documents(out: Path) -> dict[Path, str]:
    """Text of every document by path, including the pages that are in the folder above."""
    from fleet.bus.protocol.asyncapi import asyncapi
    from fleet.bus.protocol.schemas import schema_document
    from scenarios.doc_tables import fill_tables

    made = {out / "schemas.json": _json(schema_document()), out / "asyncapi.json": _json(asyncapi())}
    for page in (out.parent / name for name in PAGES):
        if page.is_file():
            made[page] = fill_tables(page.read_text(encoding="utf-8"))
    return made


def _json(document: object) -> str:
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"
