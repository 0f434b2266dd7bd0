"""Input that is refused, by a call or by a command."""

from collections.abc import Callable
from typing import Any

import pytest

from turbogs_plugin.errors import InputError


def assert_refused(words: str, function: Callable[..., object], *arguments: Any, **options: Any) -> None:
    """A call ends in an `InputError` of one short line, in which the pattern `words` is found."""
    with pytest.raises(InputError, match=words) as refused:
        function(*arguments, **options)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 500


def assert_one_line(result: tuple[int, str, str], *words: object) -> None:
    """A command ended with exit code 2 and one line on stderr, in which all of these words are."""
    code, out, err = result
    assert code == 2 and out == "" and err.startswith("turbogs: error: "), (code, out, err)
    assert err.count("\n") == 1 and err.endswith("\n") and all(str(word) in err for word in words), err
