"""A page as a list of blocks, written as Markdown with pictures beside it, or as one HTML file with all in it."""

from __future__ import annotations

import base64
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

from turbogs_plugin.report.tables import table

COLUMNS = 120
"""Of Markdown's prose."""


@dataclass(frozen=True)
class Heading:
    text: str
    level: int = 2

    def markdown(self) -> str:
        return f"{'#' * self.level} {self.text}"

    def html(self, folder: Path) -> str:
        return f"<h{self.level}>{escape(self.text)}</h{self.level}>"


@dataclass(frozen=True)
class Paragraph:
    text: str

    def markdown(self) -> str:
        return textwrap.fill(self.text, COLUMNS, break_long_words=False, break_on_hyphens=False)

    def html(self, folder: Path) -> str:
        return f"<p>{escape(self.text)}</p>"


@dataclass(frozen=True)
class Picture:
    """`file`: its name, beside the page."""

    file: str
    text: str

    def markdown(self) -> str:
        return f"![{self.text}]({quote(self.file)})"  # the path of a link holds no space

    def html(self, folder: Path) -> str:
        data = base64.b64encode((folder / self.file).read_bytes()).decode("ascii")
        return f'<p><img alt="{escape(self.text)}" src="data:image/png;base64,{data}"></p>'


@dataclass(frozen=True)
class Table:
    """`numeric`: columns after the first are numbers."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: bool = True

    def markdown(self) -> str:
        return table(self.header, self.rows)

    def html(self, folder: Path) -> str:
        kind = ' class="numeric"' if self.numeric else ""
        head, *rows = (
            "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in row) + "</tr>"
            for tag, row in [("th", self.header), *(("td", row) for row in self.rows)]
        )
        body = "\n".join(rows)
        return f'<div class="scroll"><table{kind}>\n<thead>{head}</thead>\n<tbody>\n{body}\n</tbody></table></div>'


Block = Heading | Paragraph | Picture | Table

CSS = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2024; max-width: 96rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; margin-bottom: .4rem; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
h3 { font-size: 1.05rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .88rem; margin: .8rem 0; }
th, td { padding: .32rem .7rem; text-align: left; border-bottom: 1px solid #dfe3e8; vertical-align: top; }
th { border-bottom: 2px solid #8c96a3; } tbody tr:hover { background: #f4f6f8; }
table.numeric td:not(:first-child), table.numeric th:not(:first-child) { text-align: right; white-space: nowrap; }
table.numeric td { font-variant-numeric: tabular-nums; white-space: nowrap; }
img { max-width: 100%; } p { max-width: 60rem; }
"""


def to_markdown(title: str, blocks: Sequence[Block]) -> str:
    """Markdown, for a file beside the pictures."""
    return "\n\n".join(block.markdown() for block in (Heading(title, 1), *blocks)) + "\n"


def to_html(title: str, blocks: Sequence[Block], folder: Path) -> str:
    """One HTML file with the pictures of `folder` in it, which opens from the disk and asks for nothing else."""
    body = "\n".join(block.html(folder) for block in (Heading(title, 1), *blocks))
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f"<style>{CSS}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )
