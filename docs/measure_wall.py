"""Times whole runs of `turbogs train` by the clock on the wall: README's table, of one capture after the other.

    python docs/measure_wall.py OUT CAPTURE [CAPTURE ...] [-- section.key=value ...]

Run in the project's root. OUT/wall.json has each capture's runs as soon as they have ended, three of each, beside what
earlier calls have measured; copied to docs/results/h200, it is what `make pages` makes the table of. An H200 takes
40 s for a capture of 100 photos.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from turbogs_plugin.files import write_text_atomically


def main(out: Path, captures: list[Path], overrides: list[str]) -> int:
    """Returns 1 where a capture could not be timed; the others are."""
    out.mkdir(parents=True, exist_ok=True)
    failed, record = 0, out / "wall.json"
    for capture in captures:
        one = out / f"wall-{capture.name}.json"
        command = [sys.executable, "-m", "turbogs_plugin.cli", "bench", "wall", *overrides, "--scene", str(capture)]
        print(capture.name, flush=True)
        if subprocess.run([*command, "--out", str(one)]).returncode:
            failed = 1
            continue
        reports = json.loads(record.read_text()) if record.is_file() else {}
        reports[capture.name] = json.loads(one.read_text())
        write_text_atomically(record, json.dumps(reports, indent=1) + "\n")
        one.unlink()
    return failed


if __name__ == "__main__":
    words = sys.argv[1:]
    split = words.index("--") if "--" in words else len(words)
    if split < 2:
        sys.exit("python docs/measure_wall.py OUT CAPTURE [CAPTURE ...] [-- section.key=value ...]")
    sys.exit(main(Path(words[0]), [Path(word) for word in words[1:split]], words[split + 1 :]))
