"""A page as a list of blocks, written as Markdown with pictures beside it, or as one HTML file with all in it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from turbogs_plugin.report.tables import table


@dataclass(frozen=True)
class Heading:
    text: str
    level: int = 2


@dataclass(frozen=True)
class Paragraph:
    text: str


@dataclass(frozen=True)
class Table:
    """`numeric`: columns after the first are numbers."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: bool = True


@dataclass(frozen=True)
class Picture:
    """`file`: its name, beside the page."""

    file: str
    text: str


Block = Heading | Paragraph | Table | Picture

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
    parts = [f"# {title}"]
    for block in blocks:
        if isinstance(block, Heading):
            parts.append(f"{'#' * block.level} {block.text}")
        elif isinstance(block, Paragraph):
            parts.append(block.text)
        elif isinstance(block, Table):
            parts.append(table(block.header, [[_cell(value) for value in row] for row in block.rows]))
        else:
            parts.append(f"![{block.text}]({block.file})")
    return "\n\n".join(parts) + "\n"


def to_html(title: str, blocks: Sequence[Block], folder: Path) -> str:
    """One HTML file with the pictures of `folder` in it, which opens from the disk and asks for nothing else."""
    body = [f"<h1>{html.escape(title)}</h1>"]
    for block in blocks:
        if isinstance(block, Heading):
            body.append(f"<h{block.level}>{html.escape(block.text)}</h{block.level}>")
        elif isinstance(block, Paragraph):
            body.append(f"<p>{html.escape(block.text)}</p>")
        elif isinstance(block, Table):
            body.append(_html_table(block))
        else:
            data = base64.b64encode((folder / block.file).read_bytes()).decode("ascii")
            body.append(f'<p><img alt="{html.escape(block.text)}" src="data:image/png;base64,{data}"></p>')
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
        f"<style>{CSS}</style>\n</head>\n<body>\n" + "\n".join(body) + "\n</body>\n</html>\n"
    )


def _html_table(block: Table) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    kind = ' class="numeric"' if block.numeric else ""
    rows = "\n".join(line(row, "td") for row in block.rows)
    head = line(block.header, "th")
    return f'<div class="scroll"><table{kind}>\n<thead>{head}</thead>\n<tbody>\n{rows}\n</tbody></table></div>'


def _cell(value: str) -> str:
    """A bar would end a Markdown cell."""
    return str(value).replace("|", "\\|")
