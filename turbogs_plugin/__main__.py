"""The `turbogs` command, which names the packages it lacks where only the core was installed."""

from __future__ import annotations

import sys
from types import ModuleType

from turbogs_plugin.errors import InputError, exit_code


def main() -> None:
    """Run the command line. Where the extra ``train`` is absent, one line says what the command lacks."""
    sys.exit(exit_code(_run))


def _run() -> int:
    try:
        from turbogs_plugin.cli import main as command_line

        command_line()
    except (ImportError, AttributeError) as error:
        from turbogs_plugin.doctor import COMMAND_PACKAGES, INSTALL_COMMANDS, diagnosis, lacking_packages

        lacking = lacking_packages()
        if not lacking or _package_of(error) not in COMMAND_PACKAGES:
            raise
        if sys.argv[1:] == ["doctor"]:  # which needs none of them, but for the parser of its name
            print(diagnosis())
            return 0
        verb = next((text for text in sys.argv[1:2] if not text.startswith("-")), "")
        raise InputError(f"{f'turbogs {verb}'.strip()} needs {', '.join(lacking)}: {INSTALL_COMMANDS}") from error
    return 0


def _package_of(error: ImportError | AttributeError) -> str:
    """The top package of the module that cannot be imported, or that is there and lacks a name (another version)."""
    if isinstance(error, ImportError):
        name = error.name
    else:
        name = error.obj.__name__ if isinstance(error.obj, ModuleType) else ""
    return (name or "").partition(".")[0]


if __name__ == "__main__":
    main()
