# SPDX-License-Identifier: MIT
"""System calls of real processes that fail on purpose, once, by name, place and number (Linux, x86-64).

A process that calls `install` hands every system call on disk or socket to whoever watches it (seccomp user
notification, seccomp_unotify(2)): that lets the call through, fails it with an errno, or has it write only a
part. So it is the kernel that answers, whatever code asks: the interpreter, libzmq's threads, a child.
"""

import ctypes
import errno
import fcntl
import os
import platform
import re
import select
import socket
import struct
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

# linux/seccomp.h, linux/audit.h, linux/filter.h
_SET_MODE_FILTER, _NEW_LISTENER, _WAIT_KILLABLE = 1, 1 << 3, 1 << 5
_RECEIVE, _ANSWER = 0xC0502100, 0xC0182101
_NOTICE, _REPLY = struct.Struct("<QIIiIQ6Q"), struct.Struct("<QqiI")
_ALLOW, _NOTIFY = 0x7FFF0000, 0x7FC00000
_LOAD, _EQUAL, _MORE, _HAS_BIT, _RETURN = 0x20, 0x15, 0x25, 0x45, 0x06
_ARGUMENTS = 16  # where they stand
_X86_64 = 0xC000003E
_SECCOMP, _NO_NEW_PRIVS, _PIDFD_GETFD = 317, 38, 438
_SET_PTRACER, _ANYBODY = 0x59616D61, -1
_READ, _WRITE, _MMAP, _ANONYMOUS = 0, 1, 9, 0x20

# name → number, and where its place stands: the argument that is a descriptor or a path
_DESCRIPTOR, _PATH, _AT, _NEW_PATH, _NEW_AT = "fd", "path", "at", "new path", "new at"
CALLS: dict[int, tuple[str, str]] = {
    _READ: ("read", _DESCRIPTOR), _WRITE: ("write", _DESCRIPTOR), 2: ("open", _PATH), 4: ("stat", _PATH),
    5: ("stat", _DESCRIPTOR), 6: ("stat", _PATH), _MMAP: ("mmap", "mmap"), 17: ("pread", _DESCRIPTOR),
    18: ("pwrite", _DESCRIPTOR), 44: ("send", _DESCRIPTOR), 45: ("recv", _DESCRIPTOR),
    73: ("flock", _DESCRIPTOR), 74: ("fsync", _DESCRIPTOR), 75: ("fdatasync", _DESCRIPTOR),
    76: ("ftruncate", _PATH), 77: ("ftruncate", _DESCRIPTOR), 82: ("rename", _NEW_PATH), 83: ("mkdir", _PATH),
    84: ("rmdir", _PATH), 87: ("unlink", _PATH), 137: ("statvfs", _PATH), 138: ("statvfs", _DESCRIPTOR),
    217: ("listdir", _DESCRIPTOR), 257: ("open", _AT), 258: ("mkdir", _AT), 262: ("stat", _AT),
    263: ("unlink", _AT), 264: ("rename", _NEW_AT), 316: ("rename", _NEW_AT), 332: ("stat", _AT),
}  # fmt: skip
_WRITES = ("write", "pwrite", "send")
SHORT = -1  # instead of an errno: the call writes a half of what it was given


class _Instruction(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_ushort),
        ("yes", ctypes.c_ubyte),
        ("no", ctypes.c_ubyte),
        ("k", ctypes.c_uint),
    )


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.POINTER(_Instruction)))


def is_possible() -> bool:
    """Whether this system can do it."""
    actions = Path("/proc/sys/kernel/seccomp/actions_avail")
    if sys.platform != "linux" or platform.machine() != "x86_64" or not actions.exists():
        return False
    return "user_notif" in actions.read_text().split()


# --- in the process that is watched ---


def install(watcher: str, name: str) -> None:
    """Hand this process's system calls to the `Watcher` at a socket, as those of `name`."""
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(watcher)
        listener = _listen()
        link.sendmsg([name.encode()], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", listener))])
        os.close(listener)


def _listen() -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")
    libc.prctl(_SET_PTRACER, _ANYBODY, 0, 0, 0)  # where Yama lets only parents look into a process
    program = _program()
    listener = libc.syscall(_SECCOMP, _SET_MODE_FILTER, _NEW_LISTENER | _WAIT_KILLABLE, ctypes.byref(program))
    if listener < 0:  # before Linux 5.19
        listener = libc.syscall(_SECCOMP, _SET_MODE_FILTER, _NEW_LISTENER, ctypes.byref(program))
    if listener < 0:
        raise OSError(ctypes.get_errno(), "seccomp")
    return int(listener)


def _program() -> _Program:
    """Notify of every call in `CALLS`, but of memory that is no file's and of what libzmq's threads say.

    Those write and read 8 bytes at a time, and do not bear to be interrupted by a signal there.
    """
    numbers = [number for number in CALLS if number not in (_MMAP, _READ, _WRITE)]
    count = len(numbers)
    code = [
        _Instruction(_LOAD, 0, 0, 4),
        _Instruction(_EQUAL, 0, count + 7, _X86_64),
        _Instruction(_LOAD, 0, 0, 0),
        _Instruction(_EQUAL, 0, 2, _MMAP),
        _Instruction(_LOAD, 0, 0, _ARGUMENTS + 8 * 3),
        _Instruction(_HAS_BIT, count + 3, count + 4, _ANONYMOUS),
        _Instruction(_MORE, 2, 0, _WRITE),
        _Instruction(_LOAD, 0, 0, _ARGUMENTS + 8 * 2),
        _Instruction(_EQUAL, count, count + 1, 8),
        *(_Instruction(_EQUAL, count - i, 0, number) for i, number in enumerate(numbers)),
        _Instruction(_RETURN, 0, 0, _ALLOW),
        _Instruction(_RETURN, 0, 0, _NOTIFY),
    ]
    return _Program(len(code), (_Instruction * len(code))(*code))


# --- in the process that watches ---


class Call(NamedTuple):
    """A system call: which process makes it, which it is, on what, and the how-manieth of that kind."""

    process: str
    name: str
    place: str
    number: int

    def __str__(self) -> str:
        return f"{self.process}: {self.name} {self.place} #{self.number}"


class Watcher:
    """Answers the system calls of the processes that `install` with its `address`, as long as it lives.

    Args:
        address: a path for its socket, short.
        places: a name for each path that counts; None = it is none of those.
        decide: an errno for a call, SHORT, or 0 = it is let through. Called in a thread of each process.

    Attributes:
        counts: calls by process, name and place.
    """

    def __init__(
        self, address: str, places: Callable[[str], str | None], decide: Callable[[Call], int]
    ) -> None:
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self._places, self._decide = places, decide
        self._counting = threading.Lock()
        self._link = socket.socket(socket.AF_UNIX)
        self._link.bind(f"{address}.new")
        self._link.listen()
        os.rename(f"{address}.new", address)  # it is there when it answers
        threading.Thread(target=self._meet, daemon=True).start()

    def _meet(self) -> None:
        while True:
            peer, _ = self._link.accept()
            with peer:
                size = struct.calcsize("3i")
                pid, _, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
                name, (listener,), _, _ = socket.recv_fds(peer, 64, 1)
            threading.Thread(target=self._watch, args=(listener, pid, name.decode()), daemon=True).start()

    def _watch(self, listener: int, pid: int, name: str) -> None:
        poll = select.poll()
        poll.register(listener, select.POLLIN)
        process = _Process(pid, name)
        while poll.poll()[0][1] & select.POLLIN:
            notice = bytearray(_NOTICE.size)
            try:
                fcntl.ioctl(listener, _RECEIVE, notice)
                number, thread, _, call, _, _, *arguments = _NOTICE.unpack(notice)
                error, value = 0, 0
                if process.has(thread):
                    error, value = self._answer(process, thread, call, arguments)
                reply = _REPLY.pack(number, value, -error, int(not error and not value))
                fcntl.ioctl(listener, _ANSWER, reply)
            except OSError as refusal:
                if refusal.errno not in (errno.ENOENT, errno.ESRCH):  # the process was killed meanwhile
                    raise
        os.close(listener)

    def _answer(self, process: "_Process", thread: int, number: int, arguments: list[int]) -> tuple[int, int]:
        """An errno and a result; 0 and 0 = the call is let through."""
        path = _path(thread, number, arguments)
        is_socket = path.startswith("socket:")
        place = process.kind_of_socket(thread, arguments[0], path) if is_socket else self._places(path)
        if place is None:
            return 0, 0
        name, kind = CALLS[number]
        if name == "open" and arguments[2 if kind == _AT else 1] & os.O_CREAT:
            name = "create"
        with self._counting:
            key = (process.name, name, place)
            self.counts[key] += 1
            call = Call(*key, self.counts[key])
        code = self._decide(call)
        if code != SHORT:
            return code, 0
        return 0, _write_half(thread, number, arguments) if name in _WRITES else 0


class _Process:
    """A watched process. Its children inherit the filter, and are let through."""

    def __init__(self, pid: int, name: str) -> None:
        self.name = name
        self._pid = pid
        self._threads: dict[int, bool] = {}
        self._sockets: dict[str, str | None] = {}  # by their inode

    def has(self, thread: int) -> bool:
        if thread not in self._threads:
            self._threads[thread] = _process_of(thread) == self._pid
        return self._threads[thread]

    def kind_of_socket(self, thread: int, descriptor: int, link: str) -> str | None:
        """`tcp`, `unix`, or None for any other."""
        if link not in self._sockets:
            with socket.socket(fileno=_borrow(thread, descriptor)) as one:
                families = {socket.AF_INET: "tcp", socket.AF_INET6: "tcp", socket.AF_UNIX: "unix"}
                self._sockets[link] = families.get(one.family)
        return self._sockets[link]


def _process_of(thread: int) -> int:
    status = Path(f"/proc/{thread}/status").read_text()
    return int(re.search(r"^Tgid:\s+(\d+)", status, re.MULTILINE)[1])  # type: ignore[index]


def _path(thread: int, number: int, arguments: list[int]) -> str:
    """Subject of a call: a path, or the link of its descriptor."""
    kind = CALLS[number][1]
    if kind == "mmap":
        return _link(thread, arguments[4])
    if kind == _DESCRIPTOR:
        return _link(thread, arguments[0])
    if kind in (_PATH, _NEW_PATH):
        return _text(thread, arguments[kind == _NEW_PATH])
    folder, at = (arguments[2], arguments[3]) if kind == _NEW_AT else (arguments[0], arguments[1])
    path = _text(thread, at)
    if path.startswith("/"):
        return path
    below = "cwd" if ctypes.c_int(folder & 0xFFFFFFFF).value < 0 else f"fd/{folder}"
    base = _readlink(f"/proc/{thread}/{below}")
    return f"{base}/{path}" if path else base


def _link(thread: int, descriptor: int) -> str:
    return _readlink(f"/proc/{thread}/fd/{ctypes.c_int(descriptor & 0xFFFFFFFF).value}")


def _readlink(path: str) -> str:
    try:
        return os.readlink(path).removesuffix(" (deleted)")
    except OSError:
        return ""


def _text(thread: int, at: int) -> str:
    """The zero-terminated text at an address."""
    with open(f"/proc/{thread}/mem", "rb", buffering=0) as memory:
        page, found = 4096 - at % 4096, b""
        while b"\0" not in found and len(found) < 4096 and at:
            found += (part := os.pread(memory.fileno(), page, at))
            at, page = at + page, 4096
            if not part:
                break
    return os.fsdecode(found.partition(b"\0")[0])


def _write_half(thread: int, number: int, arguments: list[int]) -> int:
    """Do a half of a write in its place; the number of bytes, 0 = there is nothing to halve."""
    descriptor, at, size, last = arguments[:4]
    if size < 2:
        return 0
    with open(f"/proc/{thread}/mem", "rb", buffering=0) as memory:
        half = os.pread(memory.fileno(), size // 2, at)
    own = _borrow(thread, descriptor)
    try:
        if CALLS[number][0] == "pwrite":
            return os.pwrite(own, half, last)
        return os.write(own, half)
    except BlockingIOError:
        return 0
    finally:
        os.close(own)


def _borrow(thread: int, descriptor: int) -> int:
    """A copy of another process's descriptor."""
    process = os.pidfd_open(_process_of(thread))
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        own = libc.syscall(_PIDFD_GETFD, process, descriptor, 0)
        if own < 0:
            raise OSError(ctypes.get_errno(), "pidfd_getfd")
        return int(own)
    finally:
        os.close(process)
