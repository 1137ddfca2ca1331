# SPDX-License-Identifier: MIT
"""A configuration as commented TOML, the reverse of `config.load`."""

import inspect
import json
import re
from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.config import Config

# A long line as the formatter breaks it: the value and its comment in brackets of their own.
_BROKEN = re.compile(r"= \(\n +(.+)\n +\)$", re.MULTILINE)
_FIELD = re.compile(r"^    (\w+): .*?(?:  # (?P<comment>.+))?$")


def dumps(config: Config) -> str:
    """TOML that `config.load` reads back as an equal Config; settings at None are commented out."""
    tables = [table(name, getattr(config, name)) for name in ("volume", "server", "client", "scan")]
    for name, settings in config.maps.items():
        lines = (f"{key} = {_literal(value)}\n" for key, value in settings.items())
        tables.append("".join((f"[maps.{name}]\n", *lines)))
    return "\n".join(tables)


def table(name: str, struct: Struct) -> str:
    """One `[name]` table, a line a setting with its bounds and meaning."""
    summary = inspect.cleandoc(type(struct).__doc__ or "").splitlines()[0]
    lines = [f"# {summary}", f"[{name}]"]
    comments = _comments(type(struct))
    for field in msgspec.inspect.type_info(type(struct)).fields:  # type: ignore[attr-defined]
        value = getattr(struct, field.name)
        setting = f"# {field.name} =" if value is None else f"{field.name} = {_literal(value)}"
        notes = [note for note in (_allowed(field.type), comments.get(field.name)) if note]
        lines.append(setting + (f"  # {'; '.join(notes)}" if notes else ""))
    return "\n".join(lines) + "\n"


def _literal(value: Any) -> str:
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)  # booleans, integers and strings are written alike


def _allowed(kind: msgspec.inspect.Type) -> str:
    """The bounds of a number or the list of words, in words."""
    if isinstance(kind, msgspec.inspect.UnionType):
        return "; ".join(note for note in map(_allowed, kind.types) if note)
    if isinstance(kind, msgspec.inspect.LiteralType):
        return " | ".join(map(str, kind.values))
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    bounds = [
        f"{sign} {getattr(kind, name)}"
        for name, sign in signs.items()
        if getattr(kind, name, None) is not None
    ]
    return ", ".join(bounds)


def _comments(struct: type[Struct]) -> dict[str, str]:
    """The comments beside the fields in config.py, so that no setting is explained twice."""
    try:
        source = inspect.getsource(struct)
    except OSError:  # installed without sources
        return {}
    matches = filter(None, map(_FIELD.match, _BROKEN.sub(r"= \1", source).splitlines()))
    return {match[1]: match["comment"] for match in matches if match["comment"]}
