"""Links, anchors and file names in the pages of the project lead somewhere."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
TOP_FOLDERS = (
    "fleet",
    "twin",
    "agents",
    "scenarios",
    "tests",
    "benchmarks",
    "examples",
    "docs",
    "notebooks",
    "constraints",
)


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_link_leads_to_a_file_and_a_heading():
    broken = []
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            if target.startswith("http"):
                continue
            file, _, anchor = target.partition("#")
            path = (page.parent / file).resolve() if file else page
            if not path.exists() or (anchor and anchor not in anchors(path)):
                broken.append(f"{page.name}: {target}")
    assert broken == []


def test_every_path_in_a_page_exists():
    named = [
        (page.name, path.rstrip("."))
        for page in PAGES
        for path in re.findall(rf"\b((?:{'|'.join(TOP_FOLDERS)})/[\w./-]*)", page.read_text(encoding="utf-8"))
    ]
    assert [pair for pair in named if not (ROOT / pair[1]).exists()] == []


def is_in_source(name: str) -> bool:
    """Whether `fleet.job.Job` names a module of ours, or what the source of one mentions."""
    parts = name.split(".")
    module = [ROOT.joinpath(*parts[:n]) for n in range(len(parts), 0, -1)]
    found = next(path for path in module if path.is_dir() or path.with_suffix(".py").is_file())
    rest = parts[len(found.relative_to(ROOT).parts) :]
    source = found / "__init__.py" if found.is_dir() else found.with_suffix(".py")
    return not rest or re.search(rf"\b{rest[0]}\b", source.read_text(encoding="utf-8")) is not None


def test_every_module_in_a_page_exists():
    module = re.compile(r"\b((?:fleet|twin|agents|scenarios)(?:\.\w+){2,})")
    named = [(page.name, name) for page in PAGES for name in module.findall(page.read_text(encoding="utf-8"))]
    assert [pair for pair in named if not is_in_source(pair[1])] == []
