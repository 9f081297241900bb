"""Pages of the site that are made from other files of the repository, and links between the two.

README.md is the first page; examples, scenario files and notebooks get a page each.
"""

import base64
import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
LANGUAGES = {".py": "python", ".mjs": "javascript", ".toml": "toml", ".cff": "yaml"}
_LINK = re.compile(r"(?P<before>\]\()(?P<target>(?!https?:|mailto:|#)[^)#\s]+)(?P<anchor>#[^)\s]*)?(?P<after>\))")


def site_paths() -> dict[str, str]:
    """Page by path of the file in the repository that it is made from."""
    pages = {"README.md": "index.md", "CITATION.cff": "citation.md"}
    pages |= {f"{name.upper()}.md": f"{name}.md" for name in ("changelog", "contributing")}
    for folder, kinds in (("examples", ("py", "mjs")), ("scenarios/library", ("toml",)), ("notebooks", ("ipynb",))):
        for kind in kinds:
            for file in (ROOT / folder).glob(f"*.{kind}"):
                pages[f"{folder}/{file.name}"] = f"{folder.rsplit('/')[-1]}/{file.stem}.md"
    return pages


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from other files."""
    for source, page in site_paths().items():
        file = ROOT / source
        text = file.read_text(encoding="utf-8")
        if file.suffix == ".ipynb":
            text = notebook_page(text)
        elif file.suffix != ".md":
            text = f"# {file.name}\n\n`{source}`\n\n```{LANGUAGES[file.suffix]}\n{text}```\n"
        files.append(File.generated(config, page, content=_relink(text, source, page)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Point links to files outside docs/ at their pages (Any: a `Page` of MkDocs)."""
    if page.file.generated_by:
        return markdown
    return _relink(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)


def notebook_page(text: str) -> str:
    """The cells of a notebook as Markdown, with the outputs that are stored in it."""
    parts: list[str] = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += [_output(output) for output in cell.get("outputs", ())]
    return "\n\n".join(parts) + "\n"


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        encoded = base64.b64encode(base64.b64decode("".join(data["image/png"]))).decode()
        return f'<img alt="Output of the cell above" src="data:image/png;base64,{encoded}">'
    if "text/html" in data:
        return '<div style="overflow-x: auto">' + re.sub(r"\s*\n\s*", " ", "".join(data["text/html"])) + "</div>"
    return "```text\n" + "".join(data.get("text/plain", output.get("text", ""))) + "\n```"


def _relink(markdown: str, source: str, page: str) -> str:
    """Replace links that are relative to `source`, a path in the repository, by links from the page."""
    pages = site_paths()

    def replace(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match["target"]))
        there = pages.get(target) or (target.removeprefix("docs/") if target.startswith("docs/") else None)
        if there is None:
            return match[0]
        link = posixpath.relpath(there, posixpath.dirname(page) or ".")
        return f"{match['before']}{link}{match['anchor'] or ''}{match['after']}"

    return _LINK.sub(replace, markdown)
