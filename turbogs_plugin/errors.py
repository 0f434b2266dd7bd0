"""The one exception that means "your input, not our code"."""


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
