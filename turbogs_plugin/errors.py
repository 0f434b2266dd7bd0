"""The one exception that means "your input, not our code"."""

import math


class InputError(ValueError):
    """Bad input: one line that names the thing and the remedy.

    The command line prints it on stderr without a traceback and exits with code 2.
    """


class TrainingStopped(RuntimeError):
    """A run that cannot go on: one line that says at which iteration and why.

    What the run saved before stays as it is. The command line prints it without a traceback and exits with code 1.
    """


def require(valid: bool, field: str, value: object, allowed: str) -> None:
    """Raise `InputError` unless `valid`, with one line: which field, its value, what is allowed."""
    if not valid:
        raise InputError(f"{field} = {value!r} is not valid: it must be {allowed}")


def require_not_negative(instance: object, *fields: str) -> None:
    """Raise `InputError` unless each of these attributes is a finite number >= 0."""
    for field in fields:
        value = getattr(instance, field)
        require(math.isfinite(value) and value >= 0, field, value, "a finite number >= 0")
