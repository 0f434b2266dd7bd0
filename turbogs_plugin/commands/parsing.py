"""Words of a command line to the call that they ask for. Words that no command takes are refused in one line."""

from __future__ import annotations

import functools
import io
import re
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from inspect import Parameter, getdoc, signature
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import tyro

from turbogs_plugin.commands.options import OVERRIDE
from turbogs_plugin.config.schema import nearest
from turbogs_plugin.errors import InputError

Command = Callable[..., int]

NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}
"""Type of an option -> what it takes, in words."""


def help_text(commands: Mapping[str, Command]) -> str:
    """The commands, a line each: the first clause of each docstring."""
    lines = ["TurboGS: train 3D Gaussian Splatting on few, well chosen pixels.", "", "usage: turbogs COMMAND ...", ""]
    for verb, function in commands.items():
        paragraph = " ".join((getdoc(function) or "").partition("\n\n")[0].split())
        lines.append(f"  {verb:<12} {re.split(r'[.;:]( |$)', paragraph)[0]}")
    return "\n".join([*lines, "", "turbogs COMMAND --help describes the options of a command; turbogs --version."])


def parsed(commands: Mapping[str, Command], words: Sequence[str]) -> Callable[[], int]:
    """The call that a command line asks for. `--help` after a command prints its options and leaves.

    Words of a command whose last positional parameter is a tuple of words, as changes of the configuration are, may
    stand anywhere: tyro leaves over those behind an option, and they are added to the others.

    Args:
        commands: verb -> function.
        words: words after the program's name, the verb first.

    Raises:
        InputError: words that no command takes.
    """
    verb, *rest = words
    if verb not in commands:
        raise InputError(f"no such command '{verb}': {nearest(verb, commands)}")
    function, said = commands[verb], io.StringIO()
    try:
        with redirect_stderr(said):
            call, left = tyro.cli(_later(function), prog=f"turbogs {verb}", args=rest, return_unknown_args=True)
    except SystemExit as end:
        if end.code != 2:
            raise
        raise InputError(f"turbogs {verb}: {mistake(function, rest)}; see turbogs {verb} --help") from None
    if left and (any(map(is_option, left)) or not takes_words(function)):
        raise InputError(f"turbogs {verb}: {mistake(function, rest)}; see turbogs {verb} --help")
    sys.stderr.write(said.getvalue())
    *first, last = call.args or ((),)
    return functools.partial(function, *first, (*last, *left), **call.keywords) if left else call


def _later(function: Command) -> Callable[..., functools.partial[int]]:
    """A function with the parameters of a command, which gives the command's call."""

    @functools.wraps(function)
    def given(*arguments: Any, **options: Any) -> functools.partial[int]:
        return functools.partial(function, *arguments, **options)

    return given


class Parsed(NamedTuple):
    """What a parameter takes. `kind`: its type, of a tuple its members' type. `many`: it is a tuple."""

    kind: Any
    many: bool = False

    def refusal(self, word: str) -> str:
        """What the parameter takes, in words, where it does not take this one; else empty."""
        if get_origin(self.kind) is Literal and word not in get_args(self.kind):
            *others, last = get_args(self.kind)
            return f"{', '.join(others)} or {last}"
        try:
            if self.kind in NUMBERS:
                self.kind(word)
        except ValueError:
            return NUMBERS[self.kind]
        return ""


def parsed_type(hint: Any) -> Parsed:
    """What a parameter with this type hint takes, whatever notes for tyro the hint has and whether None is in it."""
    if get_origin(hint) is Annotated:
        return parsed_type(get_args(hint)[0])
    members = [member for member in get_args(hint) if member not in (NoneType, Ellipsis)]
    if get_origin(hint) is tuple:
        return Parsed(parsed_type(members[0]).kind, many=True)
    return parsed_type(members[0]) if NoneType in get_args(hint) else Parsed(hint)


def takes_words(function: Command) -> bool:
    """Whether the last positional parameter of a command is a tuple of words."""
    positional = [name for name, each in signature(function).parameters.items() if each.kind is each.POSITIONAL_ONLY]
    hints = get_type_hints(function, include_extras=True)
    return bool(positional) and parsed_type(hints[positional[-1]]) == Parsed(str, many=True)


def is_option(word: str) -> bool:
    return word.startswith("--") or (word.startswith("-") and word[1:2].isalpha())


def mistake(function: Command, words: Sequence[str]) -> str:
    """The first thing that a command does not take of these words, which tyro refused, and what to write."""
    hints, positional, required = get_type_hints(function, include_extras=True), [], []
    options: dict[str, Parsed] = {}
    for name, parameter in signature(function).parameters.items():
        found = parsed_type(hints[name])
        if parameter.kind is Parameter.POSITIONAL_ONLY:
            shown = "|".join(get_args(found.kind)) if get_origin(found.kind) is Literal else name.upper()
            positional.append((shown, found, parameter.default is Parameter.empty))
        elif is_dataclass(found.kind):
            types = get_type_hints(found.kind, include_extras=True)
            options |= {option_of(field.name): parsed_type(types[field.name]) for field in fields(found.kind)}
        else:
            options[option_of(name)] = found
            required += [option_of(name)] if parameter.default is Parameter.empty else []
            if parameter.default is True:
                options[option_of(f"no_{name}")] = found
    loose, rest = [], deque(words)
    while rest:
        word = rest.popleft()
        if not is_option(word):
            loose.append(word)
            continue
        name, equals, value = word.partition("=")
        name = name.replace("_", "-")
        if name not in options:
            return f"there is no {name}: {_instead(name, rest[0] if rest else value, options, takes_words(function))}"
        required = [each for each in required if each != name]
        values = [value] if equals else []
        while rest and options[name].kind is not bool and not is_option(rest[0]) and not equals:
            values.append(rest.popleft())
            equals = "" if options[name].many else "="
        if not (values or options[name].many or options[name].kind is bool):
            return f"{name} lacks a value"
        for value in values:
            if said := options[name].refusal(value):
                place = "; write it before the options" if OVERRIDE.fullmatch(value) else ""
                return f"{name} '{value}': it takes {said}{place}"
    for word, (_, found, _) in zip(loose, positional, strict=False):
        if said := found.refusal(word):
            return f"'{word}': it takes {said}"
    required = [name for name, _, needed in positional[len(loose) :] if needed] + required
    if required:
        return f"it needs {' and '.join(required)}"
    return f"it takes no '{loose[len(positional)]}'" if len(loose) > len(positional) else "it cannot read these words"


def option_of(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _instead(name: str, value: str, options: Mapping[str, Parsed], with_settings: bool) -> str:
    """What to write in the place of an option that a command does not have: a setting of that name, or the nearest."""
    from turbogs_plugin.config.configuration import load_config

    sections = load_config("turbogs").to_mapping() if with_settings else {}
    key = name[2:].replace("-", "_")
    settings = [f"{section}.{key}={value}" for section, values in sections.items() if key in values]
    return f"write {' or '.join(settings)}" if settings else nearest(name, options)
