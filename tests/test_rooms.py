"""What lies where, and what importing a room loads."""

import subprocess
import sys
from pathlib import Path

import turbogs_plugin


def test_few_modules_stand_beside_the_packages():
    root = Path(turbogs_plugin.__file__).parent
    modules = {path.stem for path in root.glob("*.py")} - {"__init__"}
    assert modules <= {"types", "tiles", "errors", "error_maps", "files", "device", "cli", "doctor"}


def test_importing_the_trainer_loads_nothing_that_only_reports_need():
    code = "import sys, turbogs_plugin.train.trainer; print({'torchmetrics', 'matplotlib'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
