"""Damaged input, and calls with it, which may end in an `InputError` but take no memory to speak of."""

from __future__ import annotations

import math
import random
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from turbogs_plugin.errors import InputError

NUMBERS = (b"\xff" * 8, struct.pack("<Q", 2**60), bytes(8), struct.pack("<d", math.nan), struct.pack("<d", math.inf))
"""Eight bytes that are a hostile count or number."""


def damaged(content: bytes, choice: random.Random) -> bytes:
    """Cut, overwritten in some bytes, with a hostile number in it, or with a piece moved into it."""
    data = bytearray(content)
    kind, place = choice.randrange(4), choice.randrange(len(data))
    if kind == 0:
        del data[place:]
    elif kind == 1:
        for _ in range(choice.choice([1, 1, 4])):
            data[choice.randrange(len(data))] = choice.randrange(256)
    elif kind == 2:
        place = choice.choice([0, 8, 12, 16, 24, place])
        data[place : place + 8] = choice.choice(NUMBERS)
    else:
        source = choice.randrange(len(data))
        data[place:place] = data[source : source + choice.randrange(64)]
    return bytes(data)


REFERENCES, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
"""Linux tells the peak of a process since it was asked to forget the one before."""


def outcome_within(memory: int, function: Callable, *arguments: Any) -> Any:
    """The result of a call, or the InputError it ended in; anything else fails. `memory`: bytes of this process. A call
    that takes more is made again: it may be the first to load a library."""
    for _ in range(2):
        result, peak = _outcome(function, arguments)
        if peak < memory:
            return result
    raise AssertionError(f"{peak / 2**20:.0f} MiB, where {memory / 2**20:.0f} are allowed")


def _outcome(function: Callable, arguments: tuple) -> tuple[Any, int]:
    """What came of a call, and the bytes that it took at most."""
    REFERENCES.write_text("5")
    before = _highest()
    try:
        result = function(*arguments)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000
        result = error
    return result, _highest() - before


def _highest() -> int:
    return 1024 * int(re.search(r"VmHWM:\s*(\d+) kB", STATUS.read_text())[1])
