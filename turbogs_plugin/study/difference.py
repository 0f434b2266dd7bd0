"""Configurations as differences from a common one, and back: `restored(common, difference(common, own)) == own`.

Configurations are flat here: ``section.key`` -> value, as overrides name them.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

ABSENT = "absent"
"""Key in a difference: its value lists the paths that only the common configuration has. No path is called so, for
every path has a dot."""


def flattened(mapping: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    """``section.key`` -> value of a nested configuration.

    A mapping that is empty, or has a name with a dot, stays a value: no path could lead into it.
    """
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        path = f"{place}.{key}" if place else key
        if isinstance(value, dict) and value and not any("." in name for name in value):
            flat |= flattened(value, path)
        else:
            flat[path] = value
    return flat


def compared(mapping: Mapping[str, Any], left_out: tuple[str, ...]) -> dict[str, Any]:
    """`flattened` without the paths that begin with one of these."""
    return {path: value for path, value in flattened(mapping).items() if not path.startswith(left_out)}


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of `flattened`, but for the order of keys."""
    mapping: dict[str, Any] = {}
    for path, value in flat.items():
        *sections, key = path.split(".")
        place = mapping
        for section in sections:
            place = place.setdefault(section, {})
        place[key] = value
    return mapping


def common_configuration(flats: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """For each path the most frequent value; the first one where several are. A path that most lack is left out."""
    common: dict[str, Any] = {}
    for path in dict.fromkeys(path for flat in flats for path in flat):
        texts = Counter(_text(flat[path]) if path in flat else None for flat in flats)
        ((text, _),) = texts.most_common(1)
        if text is not None:
            common[path] = json.loads(text)
    return common


def difference(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """What `own` has other than `common`, both flat."""
    changed = {path: value for path, value in own.items() if path not in common or _text(common[path]) != _text(value)}
    absent = [path for path in common if path not in own]
    return changed | {ABSENT: absent} if absent else changed


def restored(common: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration whose `difference` from `common` this is."""
    gone = [ABSENT, *changes.get(ABSENT, ())]
    return {path: value for path, value in {**common, **changes}.items() if path not in gone}


def _text(value: Any) -> str:
    """A text to compare values by: in Python 1, 1.0 and True are equal, in a configuration they are different."""
    return json.dumps(value, sort_keys=True)
