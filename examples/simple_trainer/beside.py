"""Installs this package into an environment that a gsplat trainer runs in, and runs the trainer there with every swap.

    make wheel
    python examples/simple_trainer/beside.py --environment ENV --host .hosts/main --wheel dist/turbogs_plugin-*.whl

ENV is a virtual environment with torch, gsplat and the requirements of the host's examples. No package in it may change
by the install. Then stock and every swap train a few steps on a small capture, with ENV's own Python, gsplat and this
package from the wheel. Where there is no GPU, this project's torch reference stands for gsplat's rasterizer.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import compare
import tyro
from packaging.utils import canonicalize_name

from turbogs_plugin.captures import write_demo_capture


@dataclass
class Options:
    """
    Args:
        environment: the folder of a virtual environment; this package is installed into it.
        host: a copy of gsplat's repository, with examples/simple_trainer.py of 1.5.3 or main.
        wheel: of this package.
        steps: of each run.
    """

    environment: Path
    host: Path
    wheel: Path
    steps: int = 8


def packages(python: Path) -> dict[str, str]:
    """The packages of an environment but for this one: name -> version."""
    command = [python, "-m", "pip", "list", "--format", "json"]
    listed = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    found = {canonicalize_name(package["name"]): package["version"] for package in listed}
    return {name: version for name, version in found.items() if name != "turbogs-plugin"}


def differences(before: dict[str, str], after: dict[str, str]) -> tuple[list[str], list[str]]:
    """(packages of another version or gone, packages that are new)."""
    changed = [f"{name} {old} -> {after.get(name, 'gone')}" for name, old in before.items() if after.get(name) != old]
    return changed, [f"{name} {version}" for name, version in after.items() if name not in before]


def main(options: Options) -> list[str]:
    """What went wrong."""
    python = options.environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    for file, remedy in ((python, "give a virtual environment"), (options.wheel, "make wheel makes it")):
        if not file.is_file():
            raise SystemExit(f"{file} is not there: {remedy}")
    compare.require_host(options.host)  # before anything is installed
    before, install = packages(python), [python, "-m", "pip", "install", "--quiet", options.wheel]
    subprocess.run(install, check=True)  # with what it depends on
    subprocess.run([*install, "--force-reinstall", "--no-deps"], check=True)  # in the place of a build before this one
    changed, new = differences(before, packages(python))
    print(f"{len(before)} packages before; changed: {', '.join(changed) or 'none'}; new: {', '.join(new) or 'none'}")
    with tempfile.TemporaryDirectory() as folder:
        capture = write_demo_capture(Path(folder) / "demo", views=9, width=48, height=32)
        runs = compare.compare(
            compare.Options(
                options.host,
                (capture,),
                Path(folder),
                tuple(compare.VARIANTS),
                options.steps,
                marks=(),
                extra="--strategy.refine-start-iter 2 --strategy.refine-every 3",
                python=python.absolute(),
            )
        )
    return changed + [f"{run['variant']}: {run['error']}" for run in runs if "error" in run]


if __name__ == "__main__":
    wrong = main(tyro.cli(Options))
    print("\n".join(wrong) or "as it should be")
    sys.exit(1 if wrong else 0)
