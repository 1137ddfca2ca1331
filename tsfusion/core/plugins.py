# SPDX-License-Identifier: MIT
"""Load functions of other packages by entry points, and call them with a user's options by name."""

import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import msgspec

from tsfusion.core.errors import TsfusionError

_TYPES = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}
_T = TypeVar("_T")


def load(point: EntryPoint, error: type[TsfusionError]) -> Any:
    """Return the object that an entry point names; raise `error` if the import fails."""
    try:
        return point.load()
    except Exception as problem:
        raise error(
            f"{point.name} ({point.value}), an entry point of {point.group}, cannot be loaded: {problem!r}"
        ) from problem


def takes(function: Callable[..., Any], option: str) -> bool:
    """Return True if a function has a parameter of this name, or `**` parameters."""
    parameters = inspect.signature(function).parameters
    return option in parameters or any(each.kind is each.VAR_KEYWORD for each in parameters.values())


def signature_of(*functions: Callable[..., Any]) -> inspect.Signature:
    """Return the signature of the first function, which passes its `**options` on to the others."""
    named: dict[str, inspect.Parameter] = {}
    for function in reversed(functions):
        named |= inspect.signature(function).parameters
    shown = (one for name, one in named.items() if name not in ("self", "options", "args", "kwargs"))
    return inspect.Signature(sorted(shown, key=lambda one: one.kind))


def call(
    function: Callable[..., _T], options: dict[str, Any], *, name: str, error: type[TsfusionError]
) -> _T:
    """Call a function with a user's options by name; options that are None are left out.

    A number is accepted for text, an integer for a float, and a list for a struct such as `Intrinsics`. A
    parameter of another type accepts anything.

    `name`: the function's name, for the message. `error`: class of the error about an unknown option or a
    value of the wrong type.
    """
    parameters = inspect.signature(function).parameters
    given = {key: value for key, value in options.items() if value is not None}
    for key, value in given.items():
        if not takes(function, key):
            raise error(f"{name} takes no `{key}`; it takes {', '.join(parameters)}")
        if key in parameters:
            given[key] = _converted(key, value, parameters[key].annotation, error)
    return function(**given)


def _converted(key: str, value: Any, annotation: Any, error: type[TsfusionError]) -> Any:
    is_union = get_origin(annotation) in (Union, UnionType)
    kinds = [kind for kind in (get_args(annotation) if is_union else (annotation,)) if kind is not NoneType]
    structs = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, msgspec.Struct)]
    if not all(kind in _TYPES or kind in structs for kind in kinds):
        return value
    if isinstance(value, tuple(kinds)) and isinstance(value, bool) == (bool in kinds):
        return value
    if isinstance(value, int | float) and not isinstance(value, bool):
        if float in kinds:
            return float(value)
        if str in kinds:
            return str(value)
    try:
        return msgspec.convert(value, structs[0])
    except (IndexError, msgspec.ValidationError) as problem:
        fields = ", ".join(structs[0].__struct_fields__) if structs else ""
        expected = f"numbers [{fields}]" if structs else _TYPES[kinds[0]]
        raise error(f"`{key}` must be {expected}, got {value!r}") from problem
