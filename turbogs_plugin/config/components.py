"""Names of strategies to classes: the built-in ones, and those that others register by entry point.

A third party adds to its ``pyproject.toml``::

    [project.entry-points."turbogs.pixel_sampler"]
    my_sampler = "my_package.samplers:MySampler"

and a YAML names it by ``pixel_sampler: {type: my_sampler, ...}``. Without a package, a YAML names the class itself,
``pixel_sampler: {type: my_samplers:MySampler, ...}``; the module may be a file in the current folder. Nothing is
imported before it is named.
"""

from __future__ import annotations

import os
import re
import site
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, distributions, entry_points
from pathlib import Path
from typing import Any

from turbogs_plugin.config.typed import build_dataclass
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.strategies import PROTOCOLS, TYPES, protocols

KINDS = tuple(TYPES)


def default_type(kind: str) -> str:
    """The type that a configuration without a section of this kind gets."""
    return next(iter(TYPES[kind]))


def strategy_class(kind: str, name: Any) -> type:
    """The class behind a type's name, or the class ``module:Class`` itself. Raises `InputError` for an unknown name
    (naming the nearest and all that are known), a module that cannot be imported, or what is no dataclass."""
    known = {own: f"turbogs_plugin.strategies.{place}" for own, place in TYPES[kind].items()}
    if isinstance(name, str) and ":" in name:
        known = {name: name}
        if not {"", os.getcwd()} & {*sys.path}:
            sys.path.append(os.getcwd())  # last, so that a file here hides no installed module
    elif name not in known:  # entry points stand in the files of every installed package
        known = {point.name: point.value for point in entry_points(group=f"turbogs.{kind}")} | known
    if name not in known:
        others = "another's is module:Class, or the name that its installed package gives it"
        raise InputError(f"unknown {kind}.type '{name}': {nearest(name, known)}; {others}")
    place = f"{kind}.type '{name}'" + (f" ({known[name]})" if known[name] != name else "")
    try:
        found = EntryPoint(name, known[name], f"turbogs.{kind}").load()
    except (Exception, SystemExit) as error:  # another's module can do anything as it is imported
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        if isinstance(error, ModuleNotFoundError):
            reason += "; call this in the folder that the module lies in, name that in PYTHONPATH, or install it"
        raise InputError(f"{place} cannot be imported: {reason}") from error
    if not (isinstance(found, type) and is_dataclass(found)):
        raise InputError(f"{place} is not a dataclass, whose init fields would be its configuration")
    return found


def foreign_code(mapping: Mapping[str, Any]) -> dict[str, str]:
    """Types in a configuration whose code nobody installed: ``section.type 'name'`` -> the file that importing it would
    run. Nothing is imported.

    Installed are the built-in types, entry points of packages in Python's own folders, and modules that lie there.
    """
    places = [folder for folder in (*site.getsitepackages(), site.getusersitepackages()) if folder]
    installed = {(point.group, point.name) for each in distributions(path=places) for point in each.entry_points}
    found = {}
    for kind in KINDS:
        section, group = mapping.get(kind), f"turbogs.{kind}"
        name = str(section.get("type", default_type(kind))) if isinstance(section, Mapping) else default_type(kind)
        values = [name] if ":" in name else [point.value for point in entry_points(group=group, name=name)]
        if name in TYPES[kind] or (group, name) in installed:
            continue
        for value in values:
            spec = PathFinder.find_spec(re.split("[.:]", value)[0], [*sys.path, os.getcwd()])
            file = str(spec and (spec.origin or spec.name))
            if not {*map(Path, places)} & {*Path(file).parents}:
                found[f"{kind}.type '{name}'"] = file if spec else "no such module is there"
    return found


def build(kind: str, mapping: Any) -> Any:
    """A new strategy from ``{"type": name, **its init fields}``. Raises `InputError` for an unknown kind, type or key,
    a wrong type of a value, one out of range, or a class without what its kind's protocol has."""
    if kind not in TYPES:
        raise InputError(f"unknown kind of strategy '{kind}': {nearest(kind, KINDS)}")
    type_name = mapping.get("type", default_type(kind)) if isinstance(mapping, Mapping) else default_type(kind)
    strategy: Any = build_dataclass(strategy_class(kind, type_name), mapping, kind, apart=("type",))
    return completed(kind, strategy, f"{kind}.type '{type_name}'")


def completed(kind: str, strategy: Any, named: str) -> Any:
    """The strategy, with the defaults of its kind's protocol where it has none of its own. Raises `InputError`, which
    calls it `named`, where it lacks what the protocol has."""
    # Run-time state counts as present, and no value is read: reading may need `setup`.
    present = {*dir(strategy), *(field.name for field in (fields(strategy) if is_dataclass(strategy) else ()))}
    protocol = getattr(protocols, PROTOCOLS[kind])
    members = {name: value for name, value in vars(protocol).items() if name[0] != "_" or name == "__call__"}
    absent = {name: value for name, value in members.items() if name not in present}
    missing = [name for name, value in absent.items() if callable(value) or isinstance(value, property)]
    if missing:
        remedy = f"inherit from turbogs_plugin.strategies.{PROTOCOLS[kind]} for the defaults, and write the rest"
        raise InputError(f"{named} is no {PROTOCOLS[kind]}: it lacks {', '.join(missing)}; {remedy}")
    for attribute, default in absent.items():
        object.__setattr__(strategy, attribute, default)  # of a frozen dataclass, too
    return strategy
