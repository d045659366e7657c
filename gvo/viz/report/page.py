"""The HTML page: head, tables and plots in one file without external links."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from gvo._text import html_text
from gvo.errors import ConfigurationError, write_faults
from gvo.viz.plots import check_suffix
from gvo.viz.report.paths import Line, World, scene_json
from gvo.viz.report.sheets import Plot

_DASHES = {"-": "", "--": "6 4", "-.": "6 3 1 3", ":": "2 3"}


def write_page(path: Path, title: str, body: Iterable[str]) -> None:
    """Write an HTML page.

    Parameters
    ----------
    path : Path
        Replaced if it exists.
    title : str
    body : iterable of str
        HTML, with all text escaped.

    Raises
    ------
    ConfigurationError
        When the suffix is not .html or .htm, or the file cannot be written.
    """
    check_suffix(path, (".html", ".htm"))
    page = "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            # no request for an icon either
            '<link rel="icon" href="data:,">',
            f"<title>{html_text(title)}</title>\n<style>\n{_resource('page.css')}</style>",
            "</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )
    with write_faults(ConfigurationError, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8", newline="\n")


def plots_html(
    plots: Sequence[Plot], lines: Sequence[Line] = (), world: World | None = None
) -> Iterator[str]:
    """Yield the sections of the plots; the one in space rotates if lines are given."""
    is_open = False
    for plot in plots:
        if plot.is_half != is_open:
            yield '<div class="pair">' if plot.is_half else "</div>"
            is_open = plot.is_half
        if plot.slug == "space" and world is not None:
            yield _turning(plot, lines, world)
        else:
            yield _section(plot)


def _section(plot: Plot) -> str:
    text = html_text(plot.text)
    if plot.figure is None:
        body = f'<p class="absent">{text}</p>'
    else:
        body = f'<p class="note">{text}</p>\n<div class="panel">{plot.svg()}</div>'
    return f'<section id="{plot.slug}">\n<h2>{html_text(plot.title)}</h2>\n{body}\n</section>'


def _turning(plot: Plot, lines: Sequence[Line], world: World) -> str:
    """Return the view in space: a canvas if scripts run, else the still figure."""
    legend = "".join(_legend_entry(line) for line in lines)
    return f"""<section id="{plot.slug}">
<h2>{html_text(plot.title)}</h2>
<p class="note">{html_text(plot.text)}</p>
<div id="turning">
<p class="note">Drag or use the arrow keys to rotate, + and - or the wheel (after a click) to zoom,
double-click or Home to reset.</p>
<div class="panel"><canvas id="scene" tabindex="0" role="img"
aria-label="{html_text(plot.title)}"></canvas>
<ul class="legend">{legend}</ul></div>
</div>
<div id="standing"><div class="panel">{plot.svg()}</div></div>
<script type="application/json" id="scene-data">{scene_json(lines, world)}</script>
<script>
{_resource("scene.js")}</script>
</section>"""


def _legend_entry(line: Line) -> str:
    dash = _DASHES[line.style.linestyle]
    return (
        '<li><svg viewBox="0 0 34 10" aria-hidden="true"><path d="M1 5H33" fill="none" '
        f'stroke="{line.style.color}" stroke-width="2.5" stroke-dasharray="{dash}"/></svg>'
        f"{html_text(line.name)}</li>"
    )


def table_html(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with names in the first column, numbers in the others."""
    body = "".join(_row("td", row) for row in rows)
    table = f"<table><thead>{_row('th', header)}</thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


def _row(tag: str, texts: Sequence[str]) -> str:
    name, *numbers = map(html_text, texts)
    cells = "".join(f'<{tag} class="number">{number}</{tag}>' for number in numbers)
    return f"<tr><{tag}>{name}</{tag}>{cells}</tr>"


def facts_html(facts: Mapping[str, str]) -> str:
    """Return a table of facts by name, without empty ones."""
    rows = "".join(
        f"<tr><th>{html_text(name)}</th><td>{html_text(text)}</td></tr>"
        for name, text in facts.items()
        if text
    )
    return f'<table class="facts"><tbody>{rows}</tbody></table>'


def list_html(title: str, items: Iterable[str], *, kind: str = "") -> str:
    """Return a titled list; empty without items."""
    entries = "".join(f"<li>{html_text(item)}</li>" for item in items)
    if not entries:
        return ""
    return f'<section class="{kind}">\n<h2>{html_text(title)}</h2>\n<ul>{entries}</ul>\n</section>'


def configuration_html(
    configuration: Mapping[str, Any], defaults: Mapping[str, Mapping[str, Any]]
) -> str:
    """Return all parameters by section; changed ones are marked, with their defaults."""
    sections = [
        _configuration_section(name, section, defaults.get(name, {}))
        for name, section in configuration.items()
        if isinstance(section, Mapping)
    ]
    if not sections:
        return ""
    return (
        '<h2>Configuration</h2>\n<p class="note">Changed parameters are marked.</p>\n'
        f'<div class="configuration">{"".join(sections)}</div>'
    )


def _configuration_section(
    name: str, section: Mapping[str, Any], defaults: Mapping[str, Any]
) -> str:
    rows = []
    for key, value in section.items():
        is_changed = key in defaults and defaults[key] != value
        mark = ' class="changed"' if is_changed else ""
        note = f"default {_yaml(defaults[key])}" if is_changed else ""
        cells = f"<td><code>{html_text(key)}</code></td><td>{html_text(_yaml(value))}</td>"
        rows.append(f"<tr{mark}>{cells}<td>{html_text(note)}</td></tr>")
    body = "".join(rows)
    return f"<section><h3>{html_text(name)}</h3><table><tbody>{body}</tbody></table></section>"


def _yaml(value: Any) -> str:  # noqa: ANN401
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) and abs(value) < 1e5 else str(value)


def _resource(name: str) -> str:
    return (files("gvo.viz.report") / name).read_text(encoding="utf-8")
