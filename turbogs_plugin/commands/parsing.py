"""Words of a command line to the call that they ask for. Words that no command takes are refused in one line."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from inspect import Parameter, getdoc, signature
from typing import Any

import tyro
from tyro import _errors as tyro_errors

from turbogs_plugin.errors import InputError, nearest

Command = Callable[..., int]
CHANGE = re.compile(r"\b[a-z]\w*\.[\w.]+=")
"""The beginning of a change of settings, section.key=value."""


def help_text(commands: Mapping[str, Command]) -> str:
    """The commands, a line each: the first clause of each docstring."""
    lines = ["TurboGS: train 3D Gaussian Splatting on few, well chosen pixels.", "", "usage: turbogs COMMAND ...", ""]
    for verb, function in commands.items():
        paragraph = " ".join((getdoc(function) or "").partition("\n\n")[0].split())
        lines.append(f"  {verb:<12} {re.split(r'[.;:]( |$)', paragraph)[0]}")
    return "\n".join([*lines, "", "turbogs COMMAND --help describes the options of a command; turbogs --version."])


def parsed(commands: Mapping[str, Command], words: Sequence[str]) -> Callable[[], int]:
    """The call that a command line asks for: a verb of the commands first. `--help` after it prints its options and
    leaves. Raises `InputError` for words that no command takes.

    Changes of the configuration, where a command takes them, may stand anywhere: tyro leaves over those behind an
    option, and they are added to the others.
    """
    verb, *rest = words
    if verb not in commands:
        raise InputError(f"no such command '{verb}': {nearest(verb, commands)}")
    function = commands[verb]

    @functools.wraps(function)
    def later(*arguments: Any, **options: Any) -> functools.partial[int]:
        return functools.partial(function, *arguments, **options)

    def refuse(said: str) -> None:
        raise InputError(f"turbogs {verb}: {_unknown_option(function, rest) or said}; see turbogs {verb} --help")

    for name, parameter in signature(function).parameters.items():
        option, kind = f"--{name.replace('_', '-')}", str(parameter.annotation)
        lists = "tuple[" in kind and "UseAppendAction" not in kind  # of which tyro takes the last alone
        if lists and sum(word.partition("=")[0] == option for word in rest) > 1:
            refuse(f"{option} is given twice: give it once, with all that it takes")
    with tyro_errors.on_parse_error(lambda event: refuse(_mistake(event))):
        call, left = tyro.cli(later, prog=f"turbogs {verb}", args=rest, return_unknown_args=True)
    for name, value in call.keywords.items():
        if isinstance(value, tuple) and any(isinstance(word, str) and CHANGE.match(word) for word in value):
            refuse(f"put changes of settings before --{name.replace('_', '-')}")
    if not left:
        return call
    if "overrides" not in signature(function).parameters or any(word.startswith("-") for word in left):
        refuse(f"it takes no '{' '.join(left)}'")
    *first, changes = call.args
    return functools.partial(function, *first, (*changes, *left), **call.keywords)


def _mistake(event: tyro_errors.ParseErrorEvent) -> str:
    """What tyro refuses, in one clause."""
    if isinstance(event, tyro_errors.MissingArgs):
        arguments = [missing.arg for missing in event.missing_arguments]
        names = [entry.lowered.metavar if entry.is_positional() else entry.display_name() for entry in arguments]
        return f"it needs {' and '.join(map(str, names))}"
    if isinstance(event, tyro_errors.InvalidChoice):
        return f"'{event.value}' is none of {', '.join(sorted({*event.choices} - {'None'}))}"
    if isinstance(event, tyro_errors.BadValue):
        return f"{event.argument.display_name()} lacks a value"
    if isinstance(event, tyro_errors.InstantiationFailure) and event.argument is not None:
        if event.argument.lowered.nargs == "*" and CHANGE.search(event.message):
            return f"put changes of settings before {event.argument.display_name()}"
        kind = "whole numbers" if re.search(r"\bint\b", str(event.argument.field.type)) else "numbers"
        return f"{event.argument.display_name()} takes only {kind}"
    return str(event)


def _unknown_option(function: Command, words: Sequence[str]) -> str:
    """What to write for the first option that the command does not have: the option that begins so, a setting of that
    name, or the nearest option; empty where it has all of them."""
    known = {"help"}
    for name, parameter in signature(function).parameters.items():
        if is_dataclass(parameter.default):
            known |= {entry.name for entry in fields(parameter.default)}
        elif parameter.kind is Parameter.KEYWORD_ONLY:
            known |= {name, f"no_{name}"} if isinstance(parameter.default, bool) else {name}
    for word, behind in zip(words, (*words[1:], ""), strict=False):
        option, equals, value = word.partition("=")
        name = option[2:].replace("-", "_")
        if not option.startswith("--") or name in known:
            continue
        remedy = nearest(option, (f"--{entry.replace('_', '-')}" for entry in known))
        if name in signature(function).parameters:  # and not known: positional
            remedy = f"write the {name.upper()} without {option}"
        elif "overrides" in signature(function).parameters:
            from turbogs_plugin.config.configuration import settings_named

            said = value if equals else "" if behind.startswith("--") else behind
            beginning = any(entry.startswith(name) for entry in known)
            settings = [] if beginning else [f"{setting}={said or 'VALUE'}" for setting in settings_named(name)]
            remedy = f"write {' or '.join(settings)}" if settings else remedy
        return f"there is no {option}: {remedy}"
    return ""
