"""HTML from the templates of this folder: every text is escaped, and control characters are shown."""

from functools import cache
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from fleet.errors import visible


def render(template: str, **values: object) -> Markup:
    """The text of a template; the same values give the same text."""
    return Markup(_environment().get_template(template).render(values))


@cache
def static(name: str) -> str:
    """A file of `static`."""
    return files("scenarios.show").joinpath("static", name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("scenarios.show"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: visible(value, "\n") if type(value) is str else value,  # not of Markup
    )
