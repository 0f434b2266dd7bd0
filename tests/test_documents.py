"""README and docs/: links, files, commands and options that they name are there; their tables are made of files."""

import json
import re
import sys
from pathlib import Path

import pytest

from turbogs_plugin.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GSPLATS = {"examples/simple_trainer.py"}
"""Files of gsplat's repository that pages name."""
FOLDERS = ("turbogs_plugin/", "strategies/", "csrc/", "configs/", "docs/", "examples/", "tests/")


def anchors(page: Path) -> set[str]:
    """What GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_and_named_files_are_there(page):
    text = page.read_text(encoding="utf-8")
    missing = []
    for link in re.findall(r"\]\((?!http)([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        missing += [link] if not target.exists() or (anchor and anchor not in anchors(target)) else []
    named = re.findall(r"`([\w./-]+)`", text)
    missing += [
        name for name in named if name.startswith(FOLDERS) and not (ROOT / name).exists() and name not in GSPLATS
    ]
    assert missing == []


def test_commands_and_options_that_pages_name_are_there():
    """An option is looked for in the modules of commands, under its name in Python."""
    commands = "\n".join(path.read_text() for path in (ROOT / "turbogs_plugin/commands").glob("*.py"))
    known = set(re.findall(r"\w+", commands))
    wrong = []
    for page in PAGES:
        text = re.sub(r"\\\n", "", page.read_text(encoding="utf-8"))
        for said in re.findall(r"\bturbogs ([a-z][^\n`#]*)", text):
            names, *_ = said.split()
            wrong += [f"{page.name}: {said}"] if not set(names.split("|")) & set(COMMANDS) else []
            if names in COMMANDS:
                options = re.findall(r"(?<![\w-])--(?:no-)?([a-z][\w-]*)", said)
                wrong += [f"{page.name}: {said}: --{name}" for name in options if name.replace("-", "_") not in known]
    assert wrong == []


BY_HAND = {"architecture", "captures", "formats", "guards", "numerics", "plan", "speed", "tried"}
"""Pages with tables of their own numbers: measured when and how they say, versions, sections."""


@pytest.mark.parametrize("planted", ["", "| mine | 31.46 |\n"])
def test_numbers_in_tables_are_of_files(planted):
    """Outside the blocks that are made of records, a table, and README's text, names settings' numbers alone."""
    files = [*(ROOT / "configs").rglob("*.yaml"), ROOT / "docs" / "lab" / "rows.yaml"]
    texts = [path.read_text() for path in files]
    texts += [str(json.loads(path.read_text())["variants"]) for path in ROOT.glob("docs/lab/*/results.json")]
    number = r"(?<!Python )(?<!section )(?<![\w.])\d*\.\d+(?:e-?\d+)?(?![\w.])"  # not Python 3.10, section 3.7
    known = set(map(float, re.findall(number, " ".join(texts))))
    wrong = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8") + planted
        text = re.sub(r"<!-- made: .*?<!-- end -->|^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
        lines = [line for line in text.splitlines() if page.stem not in BY_HAND and line.startswith("|")]
        said = re.findall(number, "\n".join([*lines, text] if page == PAGES[0] else lines))
        wrong += [f"{page.name}: {found}" for found in said if float(found) not in known]
    assert bool(wrong) == bool(planted), wrong


def test_nothing_advises_to_install_a_strangers_package():
    """This package is on no index: its name alone would bring whatever somebody else puts there."""
    files = [path for of in ("turbogs_plugin", "examples", "docs", ".ci") for path in (ROOT / of).rglob("*")]
    files = [path for path in (*files, *PAGES) if path.suffix in (".py", ".md", ".sh")]
    advice = re.compile(r"pip install (-\S+ )*[\"']?turbogs[-_]plugin")
    assert [path.name for path in files if advice.search(path.read_text(encoding="utf-8"))] == []


def test_make_pages_would_change_nothing(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "lab"))
    import make_pages

    assert [page.name for page in PAGES if make_pages.filled(page.read_text()) != page.read_text()] == []
    for name in ("make_pages", "paper_tables", "record", "studies", "timings"):
        sys.modules.pop(name, None)
