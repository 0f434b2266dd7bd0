"""Input that is refused."""

from collections.abc import Callable
from typing import Any

import pytest

from turbogs_plugin.errors import InputError


def assert_refused(words: str, function: Callable[..., object], *arguments: Any, **options: Any) -> None:
    """A call ends in an `InputError` of one short line, in which the pattern `words` is found."""
    with pytest.raises(InputError, match=words) as refused:
        function(*arguments, **options)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 500
