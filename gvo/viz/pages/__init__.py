"""HTML pages in one file each: Jinja2 templates, one style sheet, no links to elsewhere."""

from __future__ import annotations

from base64 import b64encode
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from gvo._text import number_text, visible
from gvo.errors import ConfigurationError, write_faults
from gvo.viz.names import PAGES, check_suffix


def write_page(path: Path, template: str, **values: Any) -> None:  # noqa: ANN401 - any text
    """Write an HTML page.

    Parameters
    ----------
    path : Path
        Replaced if it exists.
    template : str
        Name of a file beside this module that extends `base.html`.
    **values
        What the template names. Text is escaped by the template.

    Raises
    ------
    ConfigurationError
        When the suffix is not .html or .htm, or the file cannot be written.
    """
    check_suffix(path, PAGES)
    page = _environment().get_template(template).render(values)
    with write_faults(ConfigurationError, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8", newline="\n")


def part(name: str, *values: Any) -> str:  # noqa: ANN401 - any text
    """Return a part of the page in the browser by the name of its macro in `panels.html`."""
    template = _environment().get_template("panels.html")
    return str(getattr(template.module, name)(*values))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("gvo.viz", "pages"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals.update(resource=_resource)
    environment.filters.update(
        base64=lambda data: b64encode(data).decode(), yaml=_yaml, number=_number
    )
    return environment


def _shown(value: Any) -> Any:  # noqa: ANN401
    """Show characters that control or turn a text; what markup there is, is our own."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _resource(name: str) -> Markup:
    text = (files("gvo.viz.pages") / name).read_text(encoding="utf-8")
    return Markup(text)  # noqa: S704 - a file of the package


def _number(value: str | float | None) -> str:
    return str(value) if isinstance(value, str | int) else number_text(value)


def _yaml(value: Any) -> str:  # noqa: ANN401
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) and abs(value) < 1e5 else str(value)
