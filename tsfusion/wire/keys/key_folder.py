# SPDX-License-Identifier: MIT
"""A folder of keys: this machine's own key pairs and, on a server, the allow-list of clients.

| file | content |
|---|---|
| `NAME.key_secret`, `NAME.key` | a pair, and its public half to give away; `server` is the server's own |
| `allowed.toml` | the server's allow-list: names, public keys, maps of each name; and revoked keys |

A line `"NAME" = "KEY"` in `[allowed]` lets a client use every map. With `"NAME" = { key = "KEY", maps =
["house", "yard-*"] }` it may use only these; a `*` at the end stands for any rest of a name. With `forget =
true` in the braces the client has the right to forget keyframes of other clients, too.

Only the owner can read the folder (0700) and its files (0600 from the first byte). Files are replaced whole.
"""

import logging
import math
import os
import re
import stat
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import zmq
from msgspec import Meta, Struct

from tsfusion.core import durable_files, folder_lock
from tsfusion.core.config import ClientName, MapPattern
from tsfusion.core.errors import InvalidConfig, refusals_as
from tsfusion.wire.sockets import curve

ALLOWED = "allowed.toml"

_MAX_LIST_BYTES = 1 << 20
_LIST_HEAD = "# Who may connect: written by `tsfusion keys allow` and `revoke`, read by the server at once.\n"
_PAIR_HEAD = "#   ZeroMQ CURVE {}: written by `tsfusion keys new`.\n"

Folder = str | os.PathLike[str]


_EVERY_MAP = ("*",)


class AllowedClient(Struct, frozen=True, forbid_unknown_fields=True):
    """Client of an allow-list: its public key, the maps that it may use, and a right to forget.

    Attributes:
        maps: names of maps; a `*` at the end of one stands for any rest.
        forget: True if it may forget keyframes of other clients.
    """

    key: Annotated[str, Meta(max_length=64)]
    maps: Annotated[tuple[MapPattern, ...], Meta(max_length=256)] = _EVERY_MAP
    forget: bool = False

    @property
    def limits(self) -> tuple[str, ...] | None:
        """Maps that it may use; None if it may use every map."""
        return None if "*" in self.maps else self.maps


class Allowed(Struct, frozen=True):
    """The allow-list of a server. No key is in it twice."""

    clients: dict[str, AllowedClient] = {}  # by name
    revoked: dict[str, str] = {}  # public key → the name it had


class _ListFile(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the allow-list's file. A client without limits may be its key alone."""

    allowed: dict[ClientName, Annotated[str, Meta(max_length=64)] | AllowedClient] = {}
    revoked: dict[str, ClientName] = {}


class Pair(Struct, frozen=True):
    """Name and public key of a key pair in the folder; the secret key stays in its file."""

    name: str
    public: str


def create_pair(folder: Folder, name: str, *, force: bool = False) -> Pair:
    """Make a new pair of keys, public and secret, for a name.

    Args:
        force: replace an existing pair.

    Raises:
        InvalidConfig: for a bad name, or for a name that has keys already, without `force`.
        OutputError: when the files cannot be written.
    """
    check_name(name)
    place = Path(folder).expanduser()
    durable_files.make_private_folder(place)
    with folder_lock.hold(place, wait=math.inf):
        paths = [place / f"{name}{ending}" for ending in (curve.SECRET, curve.PUBLIC)]
        for path in paths:
            if path.exists() and not force:
                raise InvalidConfig(f"{path} exists; choose another name, or replace it by --force")
        public, secret = _new_pair()
        lines = f'curve\n    public-key = "{public}"\n'
        secret_line = f'    secret-key = "{secret}"\n'
        _write(paths[0], _PAIR_HEAD.format("**Secret** Certificate") + lines + secret_line)
        _write(paths[1], _PAIR_HEAD.format("Public Certificate") + lines)
        if name == curve.SERVER and not (place / ALLOWED).exists():
            _write(place / ALLOWED, _format_list(Allowed()))
    return Pair(name, public)


def allow(
    folder: Folder,
    name: str,
    key: str | None = None,
    *,
    maps: Iterable[str] | None = None,
    forget: bool | None = None,
) -> str | None:
    """Put a client's name and public key on the allow-list. An earlier key of the name is revoked.

    Args:
        key: 40 characters, or a file; None keeps the name's present key.
        maps: names of maps that the client gets; a `*` at the end stands for any rest. None keeps the name's
            present maps; a new name then gets every map.
        forget: True gives the right to forget keyframes of other clients. None keeps the present right; a new
            name then has none.

    Returns:
        The name's earlier key if it was replaced, else None.

    Raises:
        InvalidConfig: for a bad name, key or map, a key that is taken, or a folder without a server's keys.
        OutputError: when the list cannot be written.
    """
    check_name(name)
    given = None if key is None else curve.public_key(key)
    patterns = None if maps is None else _checked_patterns(maps)
    place = _existing_folder(folder)
    with folder_lock.hold(place, wait=math.inf):
        own = curve.server_keys(place).public
        listed = read_allow_list(place) if has_allow_list(place) else Allowed()
        before = listed.clients.get(name)
        earlier = None if before is None else before.key
        public = given or earlier
        if public is None:
            raise InvalidConfig(f"no key is allowed under the name {name!r} yet: give its public key, too")
        _check_not_taken(name, public, own, listed)
        revoked = {key: was for key, was in listed.revoked.items() if key != public}
        if earlier not in (None, public):
            revoked[str(earlier)] = name
        known = before or AllowedClient(public)
        client = AllowedClient(
            public,
            known.maps if patterns is None else patterns,
            known.forget if forget is None else forget,
        )
        changed = Allowed({**listed.clients, name: client}, revoked)
        if changed != listed:
            _write(place / ALLOWED, _format_list(changed))
    return None if earlier == public else earlier


def revoke(folder: Folder, name: str) -> str:
    """Revoke the key of a client's name. Return the key.

    Raises:
        InvalidConfig: when no key is allowed under the name.
        OutputError: when the list cannot be written.
    """
    place = _existing_folder(folder)
    with folder_lock.hold(place, wait=math.inf):
        listed = read_allow_list(place)
        left = dict(listed.clients)
        if (client := left.pop(name, None)) is None:
            names = ", ".join(sorted(left))
            there = f"under these: {names}" if names else "nor under any other"
            raise InvalidConfig(f"no key is allowed under the name {name!r}, {there} (`tsfusion keys list`)")
        _write(place / ALLOWED, _format_list(Allowed(left, {**listed.revoked, client.key: name})))
    return client.key


def list_pairs(folder: Folder) -> list[Pair]:
    """List the key pairs in the folder, by name.

    Raises:
        InvalidConfig: when the folder or a pair cannot be read.
    """
    place = _existing_folder(folder)
    found = sorted(place.glob(f"*{curve.SECRET}"))
    return [Pair(path.name.removesuffix(curve.SECRET), curve.read_pair(path)[0]) for path in found]


def has_allow_list(folder: Folder) -> bool:
    """True if a folder has an allow-list. Only a server's folder has one."""
    return os.path.lexists(Path(folder).expanduser() / ALLOWED)


def read_allow_list(folder: Folder) -> Allowed:
    """Read the allow-list of a server's folder.

    Raises:
        InvalidConfig: when the list is missing or malformed, or other users can write the file.
    """
    path = Path(folder).expanduser() / ALLOWED
    with refusals_as(InvalidConfig, f"cannot read the allow-list {path}"), path.open("rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        content = file.read(_MAX_LIST_BYTES + 1)
    if durable_files.others_can_write(mode):
        raise InvalidConfig(f"others can change the allow-list {path} (mode {stat.S_IMODE(mode):04o})")
    return _parse_list(content, path)


def check_name(name: str) -> None:
    """Raise InvalidConfig unless the name is valid for a client: letters, digits and . _ -."""
    try:
        msgspec.convert(name, ClientName)
    except msgspec.ValidationError as error:
        raise InvalidConfig(
            f"a name is 1 to 32 letters, digits and . _ -, the first a letter or digit; got {name!r}"
        ) from error


def _checked_patterns(maps: Iterable[str]) -> tuple[str, ...]:
    found = tuple(dict.fromkeys(maps))
    try:
        msgspec.convert(found, AllowedClient.__annotations__["maps"])
    except msgspec.ValidationError as error:
        raise InvalidConfig(
            "maps are names of 1 to 32 of a-z, 0-9, - and _, a letter or digit first; the last may be "
            f"`*`; got {', '.join(found)!r}"
        ) from error
    return found


def _existing_folder(folder: Folder) -> Path:
    place = Path(folder).expanduser()
    try:
        durable_files.check_private_folder(place)
    except InvalidConfig as error:
        raise InvalidConfig(
            f"{error}; `tsfusion keys new {curve.SERVER}` makes a server's folder of keys, "
            "`tsfusion keys new NAME` a scanner's"
        ) from error
    return place


def _write(path: Path, text: str) -> None:
    with durable_files.written(path, private=True) as file:
        file.write(text.encode())


def _parse_list(content: bytes, path: Path) -> Allowed:
    try:
        file = msgspec.toml.decode(content, type=_ListFile)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidConfig(f"the allow-list {path} is damaged: {error}") from error
    entries = file.allowed.items()
    listed = Allowed(
        {name: AllowedClient(one) if isinstance(one, str) else one for name, one in entries}, file.revoked
    )
    keys = [*(one.key for one in listed.clients.values()), *listed.revoked]
    if len(content) > _MAX_LIST_BYTES or not all(map(curve.is_key, keys)):
        raise InvalidConfig(f"the allow-list {path} is damaged: an entry is no key, or there are too many")
    if len(set(keys)) < len(keys):
        raise InvalidConfig(f"the allow-list {path} is damaged: a key is in it twice")
    return listed


def _format_list(listed: Allowed) -> str:
    lines = [_LIST_HEAD, "[allowed]"]  # a Z85 key has no quote and no backslash, nor has a map's name
    for name, client in sorted(listed.clients.items()):
        rights = [f'key = "{client.key}"']
        if client.limits is not None:
            rights.append(f"maps = [{', '.join(f'{chr(34)}{one}{chr(34)}' for one in client.limits)}]")
        if client.forget:
            rights.append("forget = true")
        lines.append(
            f'"{name}" = ' + (f'"{client.key}"' if len(rights) == 1 else f"{{ {', '.join(rights)} }}")
        )
    lines += ["", "[revoked]"]
    lines += [f'"{key}" = "{name}"' for key, name in listed.revoked.items()]
    return "\n".join(lines) + "\n"


def _check_not_taken(name: str, public: str, own: str, listed: Allowed) -> None:
    if name == curve.SERVER or public == own:
        raise InvalidConfig("that is the server's own: a client needs a name and a pair of keys of its own")
    for other, client in listed.clients.items():
        if client.key == public and other != name:
            raise InvalidConfig(
                f"this key is allowed under the name {other} already; `tsfusion keys revoke {other}` frees it"
            )


def _new_pair() -> tuple[str, str]:
    """Make a key pair (public, secret) whose public key does not begin like a command option."""
    while True:
        public, secret = (key.decode("ascii") for key in zmq.curve_keypair())
        if re.match("[0-9a-zA-Z]", public):
            return public, secret


log = logging.getLogger(__name__)

_RETRY = 1.0  # seconds


class AllowedMaps(Struct, frozen=True):
    """Maps that a key may use: to send keyframes into, ask about and watch.

    Attributes:
        patterns: names of maps; a `*` at the end of one stands for any rest. None allows every map.
    """

    patterns: tuple[str, ...] | None = None

    def __contains__(self, name: str) -> bool:
        return self.patterns is None or any(
            name.startswith(one[:-1]) if one.endswith("*") else name == one for one in self.patterns
        )

    def __str__(self) -> str:
        return "every map" if self.patterns is None else ", ".join(self.patterns) or "no map"

    def denial(self, name: str) -> str:
        """Return the reason why this key cannot use a map. It does not reveal if the map exists."""
        return f"this key may not use map {name}, but: {self}"


ALL_MAPS = AllowedMaps()


class AllowList:
    """The allow-list of a server, up to date with its file. It is empty while the file cannot be read."""

    def __init__(self, folder: Folder) -> None:
        self.problem = ""  # reason why the file cannot be read; empty if it can
        self._folder = Path(folder).expanduser()
        self._path = self._folder / ALLOWED
        self._seen: tuple[int, ...] | None = ()  # the file's stamp when it was read; None without a file
        self._again = 0.0  # when to read an unreadable file again, even an unchanged one
        self._listed = Allowed()
        self._names: dict[str, str] = {}  # public key → name
        self.refresh()

    def refresh(self) -> bool:
        """Read the file again if it changed. Return True if a key lost its name or got other maps."""
        seen = self._stamp()
        if seen == self._seen and not (self.problem and time.monotonic() > self._again):
            return False
        names, before, self._seen = self._names, self._listed, seen
        try:
            durable_files.check_private_folder(self._folder)
            self._listed = read_allow_list(self._folder)
        except InvalidConfig as error:
            self._fail(str(error))
        else:
            self.problem = ""
            self._names = {one.key: name for name, one in self._listed.clients.items()}
            level = logging.INFO if self._names else logging.WARNING
            counts = len(self._names), len(self._listed.revoked)
            log.log(level, "clients that may connect: %d, keys revoked: %d", *counts)
        return any(
            self._names.get(key) != name or self._listed.clients[name].limits != before.clients[name].limits
            for key, name in names.items()
        )

    def name_of(self, key: str | None) -> str | None:
        """Return the name under which a public key is allowed, or None if it is not allowed."""
        return self._names.get(key) if key is not None else None

    def maps_of(self, name: str) -> AllowedMaps:
        client = self._listed.clients.get(name)
        return AllowedMaps(() if client is None else client.limits)

    def may_forget_all(self, name: str) -> bool:
        """True if a client has the right to forget keyframes of other clients, in its own maps."""
        client = self._listed.clients.get(name)
        return client is not None and client.forget

    def rejection_reason(self, key: str) -> str:
        """Return one word for why a key is not allowed, such as `revoked`."""
        if self.problem:
            return "allow-list"
        return "revoked" if key in self._listed.revoked else "unknown"

    def _stamp(self) -> tuple[int, ...] | None:
        try:
            stat = os.stat(self._path)
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino, stat.st_size

    def _fail(self, problem: str) -> None:
        if problem != self.problem:
            log.error("nobody is allowed to connect: %s", problem)
        self.problem = problem
        self._again = time.monotonic() + _RETRY
        self._names, self._listed = {}, Allowed()
