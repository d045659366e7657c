"""A page of a report, read again."""

import re
from html.parser import HTMLParser


class Page(HTMLParser):
    """Collects ids, links, drawn sections and the cells of tables by section."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        self.ids: list[str] = []
        self.links: list[str] = []
        self.drawn: list[str] = []
        self.tags: list[str] = []
        self.rows: dict[str, list[list[str]]] = {}
        self._section = ""
        self._is_cell = False
        self._is_figure = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        if "id" in values and not self._is_figure:
            self.ids.append(values["id"])
        self.links += [values[n] for n in ("href", "src", "xlink:href") if n in values]
        if tag == "section":
            self._section = values.get("id", "")
        if tag in ("div", "canvas") and values.get("role") == "img":
            self.drawn.append(self._section)
        self._is_figure |= tag == "svg"
        if tag == "tr":
            self.rows.setdefault(self._section, []).append([])
        if tag in ("td", "th"):
            self.rows[self._section][-1].append("")
            self._is_cell = True

    def handle_endtag(self, tag: str) -> None:
        self._is_cell &= tag not in ("td", "th")
        self._is_figure &= tag != "svg"

    def handle_data(self, data: str) -> None:
        if self._is_cell:
            self.rows[self._section][-1][-1] += data

    def facts(self) -> dict[str, str]:
        return {row[0]: row[1] for row in self.rows[""]}

    def assert_nothing_outside(self) -> None:
        """Check that all it refers to is in it, and no id of the page is there twice."""
        assert len(self.ids) == len({*self.ids})
        # Names of the language of the figures are no links.
        assert "http" not in re.sub(r' xmlns(:\w+)?="[^"]*"', "", self.text)
        assert "@import" not in self.text
        inside = [link for link in self.links if link.startswith("#")]
        inside += [f"#{name}" for name in re.findall(r"url\(#([^)]*)\)", self.text)]
        for name in inside:
            assert self.text.count(f'id="{name[1:]}"') == 1, name
        others = [link for link in self.links if not link.startswith(("#", "data:image/png"))]
        assert others == ["data:,"]
        assert not re.search(r"url\((?!#)", self.text)
