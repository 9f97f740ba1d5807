"""Reads a report the way a browser would: tags must match, and nothing may come from outside the file."""

import base64
import io
from html.parser import HTMLParser

from PIL import Image

_VOID = {"meta", "img", "br", "link", "hr", "input"}


class Page(HTMLParser):
    """Tables, images and headings of a page; raises where it is not well-formed or loads something."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.tables, self.images, self.headings, self.best = [], [], [], set()
        self._open, self._text = [], ""
        self.feed(html)
        self.close()
        assert not self._open, f"left open: {self._open}"
        for bad in ("<script", "@import", "url("):
            assert bad not in html, bad

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        for name, value in attrs.items():
            assert not (name in ("src", "href", "srcset", "data", "poster") and tag != "img"), (tag, name, value)
        if tag == "img":
            assert attrs["alt"]
            head, _, data = attrs["src"].partition(",")
            assert head == "data:image/png;base64"
            self.images.append(Image.open(io.BytesIO(base64.b64decode(data, validate=True))).convert("RGB"))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th", "h1", "h2"):
            self._text = ""
        if tag == "td" and "best" in attrs.get("class", "").split():
            self.best.add((len(self.tables) - 1, len(self.tables[-1]) - 1, len(self.tables[-1][-1])))
        if tag not in _VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open and self._open[-1] == tag, f"</{tag}> closes {self._open[-1:]}"
        self._open.pop()
        if tag in ("td", "th"):
            self.tables[-1][-1].append(self._text)
        if tag in ("h1", "h2"):
            self.headings.append(self._text)

    def handle_data(self, data):
        self._text += data


def check_table(page, number, rows):
    """Table ``number`` shows the numbers of ``rows``, and marks the smallest of each column, the floor apart."""
    lines = {row[0]: (k, row[1:]) for k, row in enumerate(page.tables[number])}
    names = ("relative_l2", "scaled_l2", "mean_error", "percentile_95")
    columns = [(split, name) for split in ("train", "test") for name in names]
    for row in rows:
        k, cells = lines[row["method"]]
        assert len(cells) == len(columns)
        for c, ((split, name), cell) in enumerate(zip(columns, cells, strict=True)):
            scale = f" ({row[split]['scale']:.2f})" if name == "scaled_l2" else ""
            assert cell == f"{row[split][name]:.3f}{scale}"
            is_best = row[split][name] == min(r[split][name] for r in rows if r["method"] != "floor")
            assert ((number, k, c + 1) in page.best) == is_best
