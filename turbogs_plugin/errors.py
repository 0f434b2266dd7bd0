"""The one exception that means "your input, not our code"."""


class InputError(ValueError):
    """Bad input: one line that names the thing and the remedy.

    The command line prints it on stderr without a traceback and exits with code 2.
    """
