"""`thermofleet contract`: schemas and AsyncAPI document of the bus, and the generated tables of the pages."""

import json
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from fleet.errors import FleetError
from scenarios.cli.terminal import out_console, say


def contract_command(
    out: Annotated[Path, typer.Option(help="Folder for the documents.")] = Path("docs/contract"),
    check: Annotated[bool, typer.Option("--check", help="Only check whether the documents are current.")] = False,
) -> None:
    """Write JSON schemas and AsyncAPI 3 document of all bus messages, and the generated tables of pages."""
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
    from scenarios.doc_tables import MARK, fill_tables
    from scenarios.evaluate.leaderboard import benchmark_tables
    from scenarios.studies.page_tables.ablations import ablation_tables
    from scenarios.studies.page_tables.channels import channel_tables
    from scenarios.studies.page_tables.cooling import cooling_tables
    from scenarios.studies.page_tables.coverage import coverage_tables
    from scenarios.studies.page_tables.learned import learned_tables
    from scenarios.studies.page_tables.policies import policy_tables
    from scenarios.studies.page_tables.processors import processor_tables
    from scenarios.studies.page_tables.sample_efficiency import efficiency_tables
    from scenarios.studies.page_tables.speed import speed_tables
    from scenarios.studies.page_tables.steps import steps_tables
    from scenarios.studies.page_tables.twin import twin_tables

    results = out.parent / "results"
    more = {
        "commands": _command_tables,
        **policy_tables(results),
        **processor_tables(results / "processors.json"),
        **channel_tables(results / "channels"),
        **coverage_tables(results / "coverage.json"),
        **benchmark_tables(results),
        **efficiency_tables(results),
        **learned_tables(results),
        **speed_tables(results / "scaling"),
        **ablation_tables(results),
        **cooling_tables(results),
        **steps_tables(results),
        **twin_tables(results),
    }
    made = {out / "schemas.json": _json(schema_document()), out / "asyncapi.json": _json(asyncapi())}
    pages = {page: page.read_text(encoding="utf-8") for page in sorted(out.parent.rglob("*.md"))}
    return made | {page: fill_tables(text, more) for page, text in pages.items() if MARK in text}


def _command_tables() -> str:
    """Each command by group, with its text, arguments and options."""
    from scenarios.cli.main import COMMANDS, load_command

    panels = dict.fromkeys(entry.panel for entry in COMMANDS.values())
    groups = {panel: [name for name, entry in COMMANDS.items() if entry.panel == panel] for panel in panels}
    return "\n\n".join(
        f"## {panel}\n\n" + "\n\n".join(_command(f"thermofleet {name}", load_command(name)) for name in names)
        for panel, names in groups.items()
    )


def _command(name: str, command: Any) -> str:
    """Any: typer keeps the class of commands private."""
    from scenarios.doc_tables import table

    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join((name, *command.collect_usage_pieces(context)))
    parts = [f"### {name}", _plain(command.help or ""), f"```\n{usage}\n```"]
    shown = [option.get_help_record(context) for option in command.get_params(context)]
    rows = [
        (f"`{names}`".replace("|", "\\|"), _plain(text)) for names, text in filter(None, shown) if names != "--help"
    ]
    if rows:
        parts.append(table(("argument or option", "meaning"), rows))
    parts += [_command(f"{name} {part}", command.commands[part]) for part in getattr(command, "commands", ())]
    return "\n\n".join(parts)


def _plain(text: str) -> str:
    """Text of the command line as Markdown, with no sign that ends a cell or begins markup."""
    spaced = re.sub(r" {2,}", " ", text)
    return re.sub(r"(`[^`]*`)|([|*<])", lambda match: match[1] or f"\\{match[2]}", spaced)


def _json(document: object) -> str:
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"
