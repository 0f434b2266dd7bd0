"""Exceptions that end a command ("your input" and "this run"), and the exit codes."""

from __future__ import annotations

import difflib
import errno
import os
import signal
import sys
from collections.abc import Callable, Iterable
from numbers import Real

LONGEST_LINE = 1200
"""Letters of an error's line: names and values of a file may have any number of them."""


class InputError(ValueError):
    """Bad input: one line that names the thing and the remedy. The command line exits with code 2."""


class TrainingStopped(RuntimeError):
    """A run that cannot go on: one line that says at which iteration and why. Files that the run saved before stay. The
    command line exits with code 1."""


def require(valid: bool, field: str, value: object, allowed: str) -> None:
    """Raise `InputError` unless `valid`, with one line: which field, its value, what is allowed."""
    if not valid:
        raise InputError(f"{field} = {value!r} is not valid: it must be {allowed}")


def is_number(value: object, whole: bool = False) -> bool:
    """Whether a value is a real number, perhaps a whole one: 12.0 and numpy's are, a bool is not."""
    return isinstance(value, Real) and not isinstance(value, bool) and (not whole or value % 1 == 0)


def nearest(name: object, known: Iterable[str]) -> str:
    """A hint for an unknown name: the nearest known one, where one is near, and all of them."""
    known = sorted(known)
    close = [each for each in known if str(name).startswith(each) or str(name) in each]
    close, names = close or difflib.get_close_matches(str(name), known, n=1, cutoff=0.67), ", ".join(known) or "none"
    return f"did you mean '{close[0]}'? (known: {names})" if close else f"known are {names}"


def refusal(error: OSError) -> str:
    """Reason for which the system refused a file, and the remedy."""
    remedy = "choose another place"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        remedy += " or make room"
    elif isinstance(error, PermissionError):
        remedy += " or give yourself leave to use it (chmod)"
    elif isinstance(error, FileNotFoundError):
        remedy = f"see that its folder is there, or {remedy}"
    return f"{error.strerror or ' '.join(map(str, error.args))}; {remedy}"


def refused_file(error: OSError) -> str:
    """The file that the system refused, where it names one, with its `refusal`."""
    place = "the system says" if error.filename is None else f"'{error.filename}'"
    return f"{place}: {refusal(error)}"


def error_line(error: Exception) -> str:
    """One line, without orders to a terminal, about an `InputError`, a `TrainingStopped` or an OSError."""
    said = refused_file(error) if isinstance(error, OSError) else str(error)
    said = "".join(letter if letter.isprintable() else "?" for letter in " ".join(said.split()))
    return f"turbogs: error: {said if len(said) <= LONGEST_LINE else f'{said[:800]} ... {said[-400:]}'}"


def exit_code(command: Callable[[], int]) -> int:
    """Run a command: 2 for bad input, 1 for a run that could not go on, 128 + n where signal n stopped it."""
    try:
        code = command()
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever read the output, `head` for one, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except (InputError, TrainingStopped, OSError) as error:
        print(error_line(error), file=sys.stderr)
        return 1 if isinstance(error, TrainingStopped) else 2
    except KeyboardInterrupt:
        print("turbogs: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
