"""Calls with damaged or hostile input, which may end in an `InputError` but take no memory to speak of."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

from turbogs_plugin.errors import InputError


def outcome_within(memory: int, function: Callable, *arguments: Any) -> Any:
    """The result of a call, or the InputError it ended in; anything else fails. `memory`: of Python and numpy."""
    tracemalloc.start()
    try:
        return function(*arguments)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000
        return error
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < memory
