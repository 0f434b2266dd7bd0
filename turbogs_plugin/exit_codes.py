"""How a command ends: its exit code, and one line on stderr where something is wrong."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable

from turbogs_plugin.errors import InputError, TrainingStopped


def exit_code(command: Callable[[], int]) -> int:
    """Run a command: 2 for bad input, 1 for a run that could not go on, 128 + n where signal n stopped it."""
    try:
        code = command()
        sys.stdout.flush()
        return code
    except (InputError, TrainingStopped) as error:
        print(f"turbogs: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    except BrokenPipeError:  # whoever read the output, `head` for one, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        place = "" if error.filename is None else f"'{error.filename}': "
        print(f"turbogs: error: {place}{error.strerror or error}; choose another place or make room", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("turbogs: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
