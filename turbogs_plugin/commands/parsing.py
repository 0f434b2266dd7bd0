"""Words of a command line to the call that they ask for. Words that no command takes are refused in one line."""

from __future__ import annotations

import functools
import io
import re
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, fields, is_dataclass
from inspect import Parameter, getdoc, signature
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro

from turbogs_plugin.commands.options import OVERRIDE
from turbogs_plugin.errors import InputError, nearest

Command = Callable[..., int]

NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}
"""Type of a value -> what is taken, in words."""


def help_text(commands: Mapping[str, Command]) -> str:
    """The commands, a line each: the first clause of each docstring."""
    lines = ["TurboGS: train 3D Gaussian Splatting on few, well chosen pixels.", "", "usage: turbogs COMMAND ...", ""]
    for verb, function in commands.items():
        paragraph = " ".join((getdoc(function) or "").partition("\n\n")[0].split())
        lines.append(f"  {verb:<12} {re.split(r'[.;:]( |$)', paragraph)[0]}")
    return "\n".join([*lines, "", "turbogs COMMAND --help describes the options of a command; turbogs --version."])


def parsed(commands: Mapping[str, Command], words: Sequence[str]) -> Callable[[], int]:
    """The call that a command line asks for. `--help` after a command prints its options and leaves.

    Changes of the configuration, where a command takes them, may stand anywhere: tyro leaves over those behind an
    option, and they are added to the others.

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

    @functools.wraps(function)
    def later(*arguments: Any, **options: Any) -> functools.partial[int]:
        return functools.partial(function, *arguments, **options)

    try:
        with redirect_stderr(said):
            call, left = tyro.cli(later, prog=f"turbogs {verb}", args=rest, return_unknown_args=True)
    except SystemExit as end:
        if end.code != 2:
            raise
        call, left = None, rest
    takes = Taken.by(function)
    if call is None or (left and (any(map(is_option, left)) or not takes.changes)):
        raise InputError(f"turbogs {verb}: {takes.mistake(rest)}; see turbogs {verb} --help")
    sys.stderr.write(said.getvalue())
    if not left:
        return call
    *first, changes = call.args
    return functools.partial(function, *first, (*changes, *left), **call.keywords)


def is_option(word: str) -> bool:
    return word.startswith("--") or (word.startswith("-") and word[1:2].isalpha())


@dataclass(frozen=True)
class Value:
    """What an option or a positional parameter takes.

    Args:
        kind: its type; of a tuple, the type of its members.
        many: whether it is a tuple.
        required: whether it has no default.
    """

    kind: Any
    many: bool
    required: bool

    @staticmethod
    def of(hint: Any, required: bool = False) -> Value:
        """The value of a type hint, whatever notes for tyro it has and whether None is in it."""
        many = False
        while get_origin(hint) in (Annotated, tuple) or NoneType in get_args(hint):
            many = many or get_origin(hint) is tuple
            hint = next(member for member in get_args(hint) if member is not NoneType)
        return Value(hint, many, required)

    def refusal(self, word: str) -> str:
        """What is taken, in words, where this word is not; else empty."""
        if get_origin(self.kind) is Literal and word not in get_args(self.kind):
            *others, last = get_args(self.kind)
            return f"{', '.join(others)} or {last}"
        try:
            if self.kind in NUMBERS:
                self.kind(word)
        except ValueError:
            return NUMBERS[self.kind]
        return ""


@dataclass(frozen=True)
class Taken:
    """The words that a command takes: values by position and by option, each with its name as a user reads it."""

    positional: dict[str, Value]
    options: dict[str, Value]

    @staticmethod
    def by(function: Command) -> Taken:
        taken, hints = Taken({}, {}), get_type_hints(function, include_extras=True)
        for name, parameter in signature(function).parameters.items():
            value = Value.of(hints[name], parameter.default is Parameter.empty)
            if parameter.kind is Parameter.POSITIONAL_ONLY:
                choices = get_args(value.kind) if get_origin(value.kind) is Literal else (name.upper(),)
                taken.positional["|".join(choices)] = value
            elif is_dataclass(value.kind):
                types = get_type_hints(value.kind, include_extras=True)
                for field in fields(value.kind):
                    taken.options[f"--{field.name.replace('_', '-')}"] = Value.of(types[field.name])
            else:
                taken.options[f"--{name.replace('_', '-')}"] = value
                if parameter.default is True:
                    taken.options[f"--no-{name.replace('_', '-')}"] = value
        return taken

    @property
    def changes(self) -> bool:
        """Whether the command takes changes of the configuration, or other words without end."""
        return any(value.many and value.kind is str for value in self.positional.values())

    def mistake(self, words: Sequence[str]) -> str:
        """The first thing that the command does not take of these words, which tyro refused, and what to write."""
        loose, given, rest = [], set(), deque(words)
        while rest:
            word = rest.popleft()
            if not is_option(word):
                loose.append(word)
                continue
            name, equals, text = word.partition("=")
            name = name.replace("_", "-")
            given.add(name)
            if name not in self.options:
                return f"there is no {name}: {self._instead(name, text or (rest[0] if rest else ''))}"
            value, texts = self.options[name], [text] if equals else []
            while rest and not is_option(rest[0]) and value.kind is not bool and (value.many or not texts):
                texts.append(rest.popleft())
            if not (texts or value.many or value.kind is bool):
                return f"{name} lacks a value"
            for text in texts:
                if said := value.refusal(text):
                    place = "; write it before the options" if OVERRIDE.fullmatch(text) else ""
                    return f"{name} '{text}': it takes {said}{place}"
        for word, value in zip(loose, self.positional.values(), strict=False):
            if said := value.refusal(word):
                return f"'{word}': it takes {said}"
        lacking = [name for name, value in [*self.positional.items()][len(loose) :] if value.required]
        lacking += [name for name, value in self.options.items() if value.required and name not in given]
        if lacking:
            return f"it needs {' and '.join(lacking)}"
        return f"it takes no '{' '.join(loose[len(self.positional) :])}'"

    def _instead(self, name: str, text: str) -> str:
        """What to write for an option that the command does not have: a setting of that name, or the nearest option."""
        from turbogs_plugin.config.configuration import load_config

        key, sections = name[2:].replace("-", "_"), load_config("turbogs").to_mapping() if self.changes else {}
        settings = [f"{section}.{key}={text}" for section, values in sections.items() if key in values]
        return f"write {' or '.join(settings)}" if settings else nearest(name, self.options)
