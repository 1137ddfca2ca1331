# SPDX-License-Identifier: MIT
"""CURVE keys: reading key files, and setting keys on sockets.

A key is 40 characters (Z85 of 32 bytes). Files are ZeroMQ certificates, as `zmq.auth.load_certificate` reads
them. `NAME.key` holds the public key, `NAME.key_secret` both keys.
"""

import os
import re
import shlex
import stat
import struct
from pathlib import Path
from typing import Any

import zmq
from msgspec import Struct
from zmq.utils import z85

from tsfusion.core.errors import InvalidConfig, refusals_as

DOMAIN = b"tsfusion"  # of the requests to the ZAP handler
PUBLIC, SECRET = ".key", ".key_secret"
SERVER = "server"  # the name of a server's own pair in its folder

_MAX_FILE_BYTES = 1 << 14
_KEY_BYTES = 32
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_LINE = re.compile(r'^\s*(public|secret)-key\s*=\s*"([^"\s]+)"\s*$', re.MULTILINE)


class ServerKeys(Struct, frozen=True):
    """A server's own pair of keys."""

    public: str
    secret: str

    def secure(self, socket: "zmq.Socket[Any]") -> None:
        """Accept only connections from allowed keys on this socket. Call it before `bind`.

        Without a ZAP handler in the socket's context nobody can connect (libzmq's default would let everybody
        in).
        """
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt_string(zmq.CURVE_SECRETKEY, self.secret)
        socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def as_client(self) -> "ClientKeys":
        """Return keys with which this server is a client of another server that has the same pair."""
        return ClientKeys(self.public, self.secret, self.public)

    def __repr__(self) -> str:
        return f"ServerKeys(public={self.public!r})"


class ClientKeys(Struct, frozen=True):
    """A client's own pair, and the public key of its server."""

    public: str
    secret: str
    server: str

    def secure(self, socket: "zmq.Socket[Any]") -> None:
        """Connect this socket only to that server. Call it before `connect`."""
        socket.setsockopt_string(zmq.CURVE_PUBLICKEY, self.public)
        socket.setsockopt_string(zmq.CURVE_SECRETKEY, self.secret)
        socket.setsockopt_string(zmq.CURVE_SERVERKEY, self.server)

    @classmethod
    def drawn(cls, server: str) -> "ClientKeys":
        """Draw a new pair, for a server with this public key. It is in no file."""
        public, secret = (key.decode("ascii") for key in zmq.curve_keypair())
        return cls(public, secret, server)

    def __repr__(self) -> str:
        return f"ClientKeys(public={self.public!r}, server={self.server!r})"


def server_keys(folder: str | os.PathLike[str]) -> ServerKeys:
    """Read the pair of the server whose keys are in this folder.

    Raises:
        InvalidConfig: when there is no pair, other users can read it, or it is malformed.
    """
    path = Path(folder).expanduser() / f"{SERVER}{SECRET}"
    if not path.exists():
        place = shlex.quote(str(folder))
        raise InvalidConfig(
            f"{path} does not exist; make the server's keys by `tsfusion keys new {SERVER} --dir {place}`"
        )
    return ServerKeys(*read_pair(path))


def client_keys(key: str | None, server_key: str | None) -> ClientKeys | None:
    """Read the keys that `ClientConfig.key` and `.server_key` name. Return None if both are None.

    Args:
        key: file of the client's own secret key.
        server_key: the server's public key, as a file or its 40 characters.

    Raises:
        InvalidConfig: when one is given without the other, a file is missing or malformed, or other users can
            read the secret key.
    """
    if key is None and server_key is None:
        return None
    if key is None or server_key is None:
        given, missing = ("server_key", "key") if key is None else ("key", "server_key")
        raise InvalidConfig(
            f"{given} needs {missing}, too: a connection with keys takes the client's own secret key (a file "
            "of `tsfusion keys new`) and the server's public key"
        )
    return ClientKeys(*read_pair(Path(key).expanduser()), server=public_key(server_key))


def public_key(given: str) -> str:
    """Read a public key from a file, or take its 40 characters.

    Raises:
        InvalidConfig: for anything else.
    """
    if is_key(given):
        return given
    path = Path(given).expanduser()
    if not os.path.exists(path):
        raise InvalidConfig(f"a public key is a file or 40 characters, got {given!r}")
    keys = _read(path, secret=False)
    if "secret" in keys:
        raise InvalidConfig(
            f"{path} holds a secret key, which stays on its machine: give the file NAME{PUBLIC} beside it"
        )
    return keys.get("public") or _none_in(path, "public", f"a file NAME{PUBLIC}")


def read_pair(path: Path) -> tuple[str, str]:
    """Read public and secret key from a file that only its owner can read.

    Raises:
        InvalidConfig: for a file that is missing or malformed, or that other users can read.
    """
    keys = _read(path, secret=True)
    secret = keys.get("secret") or _none_in(path, "secret", f"a file NAME{SECRET}")
    public = zmq.curve_public(secret.encode()).decode()
    if keys.get("public", public) != public:
        raise InvalidConfig(f"{path} is damaged: its public key does not belong to its secret key")
    return public, secret


def is_key(text: str) -> bool:
    """True for a key: 40 characters that stand for 32 bytes."""
    try:
        return len(z85.decode(text)) == _KEY_BYTES
    except (ValueError, KeyError, struct.error):  # wrong length, other characters, more than 32 bits in five
        return False


def _read(path: Path, *, secret: bool) -> dict[str, str]:
    """Return the keys in a file, by kind."""
    with (
        refusals_as(InvalidConfig, f"cannot read the key {path}", "`tsfusion keys new` makes one"),
        path.open("rb") as file,
    ):
        mode = os.fstat(file.fileno()).st_mode
        if secret and mode & _OTHERS:
            raise InvalidConfig(
                f"others can read the secret key {path} (mode {stat.S_IMODE(mode):04o}); if nobody has, "
                f"run `chmod 600 {shlex.quote(str(path))}`, else make a new one"
            )
        content = file.read(_MAX_FILE_BYTES)
    keys = dict(_LINE.findall(content.decode("utf-8", "replace")))
    for kind, key in keys.items():
        if not is_key(key):
            raise InvalidConfig(f"{path} is damaged: its {kind} key is not 40 characters that make a key")
    return keys


def _none_in(path: Path, kind: str, expected: str) -> str:
    raise InvalidConfig(f"{path} holds no {kind} key; expected {expected} of `tsfusion keys new`")
