"""What lies where, and what importing a room loads."""

import re
from pathlib import Path

import turbogs_plugin


def test_few_modules_stand_beside_the_packages():
    root = Path(turbogs_plugin.__file__).parent
    modules = {path.stem for path in root.glob("*.py")} - {"__init__"}
    assert modules <= {"types", "tiles", "errors", "error_maps", "files", "device", "cli", "doctor", "__main__"}


def test_documents_name_tests_that_are_there():
    root = Path(__file__).parents[1]
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    named = {(page.name, path) for page in pages for path in re.findall(r"\btests/[\w/]+\.py\b", page.read_text())}
    assert len(named) > 5
    assert [(page, path) for page, path in sorted(named) if not (root / path).is_file()] == []
