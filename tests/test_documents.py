"""README and docs/: links, files, commands and options that they name are there; their tables are made of files."""

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
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if link.startswith("http"):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            missing.append(link)
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


def test_make_pages_would_change_nothing(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "lab"))
    import make_pages

    assert [page.name for page in PAGES if make_pages.filled(page.read_text()) != page.read_text()] == []
    for name in ("make_pages", "paper_tables", "studies", "timings"):
        sys.modules.pop(name, None)
