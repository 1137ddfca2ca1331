# SPDX-License-Identifier: MIT
"""Connect to the process that computes on a GPU (`device_process`), and call its methods."""

import atexit
import logging
import select
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.config import Arch
from tsfusion.core.shared_arrays import (
    MOST_SAID,
    SharedArrays,
    SharedSlot,
    look_out,
    make_file,
    talking_sockets,
)

log = logging.getLogger(__name__)

Step = tuple[str, tuple[Any, ...]]  # a method and its arguments
SentArray = tuple[int, str, tuple[int, ...], bytes | int]  # argument, dtype, shape, content or offset

_COMMAND = (sys.executable, "-m", "tsfusion.tsdf.device.device_process")
_START_S = 120.0  # the first start also compiles the driver's own kernels
_END_S = 3.0
_SENT_BYTES = 1 << 10
_ANSWER_S = 0.002  # usual answer time of a GPU


class DeviceLost(RuntimeError):
    """Error of a device process that has ended, or in which a kernel failed.

    Additions since the map was last read are lost. The error is no TsfusionError: no keyframe caused it, and
    the map must not be used any more. The error ends a fuser. The next fuser starts from the last checkpoint,
    and fuses the later records of the journal.
    """


class DeviceLink:
    """Connection to the GPU process, with one call at a time, from the thread that uses maps."""

    def __init__(self, arch: Arch) -> None:
        """Start the process. Raises DeviceLost, with the reason, without such a device."""
        self.arch = arch
        self.is_trusted = False  # True after a trial that agreed with the CPU
        self._has_ended = False
        self._maps = 0
        self._forgotten: list[int] = []
        try:
            self._link, theirs = talking_sockets()
        except OSError as error:
            raise DeviceLost(f"the device {arch} cannot be used: {error}") from error
        descriptors = make_file(), make_file()
        self._requests, self._replies = (SharedArrays(one) for one in descriptors)
        with theirs:
            passed = [theirs.fileno(), *descriptors]
            ends_with_thread = threading.current_thread() is threading.main_thread()
            self._process = subprocess.Popen(
                [*_COMMAND, *map(str, passed), arch, str(int(ends_with_thread))],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=passed,
                **process.OWN_GROUP,
            )
        atexit.register(self.close)
        self._receive(_START_S)

    @property
    def has_ended(self) -> bool:
        return self._has_ended

    def new_map(self, layers: tuple[str, ...]) -> int:
        """Make an empty map on the device. Returns its number. Raises as `call`."""
        self._maps += 1
        self.call(self._maps, "make", layers)
        return self._maps

    def forget_later(self, number: int) -> None:
        """Release a map of the GPU process before the next call. Safe at any time, also during a call."""
        self._forgotten.append(number)

    def call(self, number: int, verb: str, *arguments: Any, first: Sequence[Step] = ()) -> Any:
        """Call a method of a map (`DeviceMap`). Arrays in the result are valid until the next call.

        Args:
            number: number of the map.
            verb: name of the method.
            arguments: arguments of the method; arrays are copied.
            first: methods to call before, with their arguments; an error in one of them skips the rest.

        Raises:
            MemoryError: the device has too little memory; the map is unchanged.
            DeviceLost: the device is gone.
        """
        with process.uninterrupted():  # otherwise the next call would read this answer
            while self._forgotten:
                self._ask(self._forgotten.pop(), [("forget", ())])
            return self._ask(number, [*first, (verb, arguments)])

    def _ask(self, number: int, steps: list[Step]) -> Any:
        if self._has_ended:
            raise DeviceLost(f"the process with the device {self.arch} has ended")
        self._requests.begin()
        packed = [(verb, *self._packed(arguments)) for verb, arguments in steps]
        try:
            self._link.send(msgspec.msgpack.encode((number, packed)))
        except OSError as error:
            self.close()
            raise DeviceLost(f"the process with the device {self.arch} has ended") from error
        return self._receive(None)

    def _packed(self, arguments: Sequence[Any]) -> tuple[list[Any], list[SentArray]]:
        """Return the arguments as messages, and their arrays. Large arrays go through shared memory."""
        values, arrays = list(arguments), list[SentArray]()
        for i, one in enumerate(arguments):
            if isinstance(one, np.ndarray):
                values[i] = None
                is_large = one.nbytes > _SENT_BYTES
                where = self._requests.write([one])[0].offset if is_large else one.tobytes()
                arrays.append((i, one.dtype.str, one.shape, where))
        return values, arrays

    def _receive(self, timeout: float | None) -> Any:
        how: str = "failed"
        found: Any = "its process has ended"
        with suppress(OSError):
            if timeout is None:
                look_out(self._link.fileno(), _ANSWER_S)
            if timeout is not None and not select.select([self._link], [], [], timeout)[0]:
                found = "it does not start"
            elif answer := self._link.recv(MOST_SAID):
                how, found = msgspec.msgpack.decode(answer)
        if how == "memory":
            raise MemoryError(f"the device {self.arch} has no memory for more of the map ({found})")
        if how == "failed":
            self.close()
            raise DeviceLost(f"the device {self.arch} cannot be used: {found}")
        if isinstance(found, list):
            arrays: list[NDArray[Any]] = [self._replies.read(SharedSlot(*place)) for place in found]
            return arrays
        return found

    def close(self) -> None:
        """End the process and its maps."""
        if self._has_ended:
            return
        self._has_ended = True
        atexit.unregister(self.close)
        self._link.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._requests.close()
        self._replies.close()


_links: dict[Arch, DeviceLink] = {}  # for the whole process, as Taichi's own state: one process per device
_missing = set[Arch]()


def link_to(arch: Arch) -> DeviceLink | None:
    """Return the connection to a GPU process, shared by all maps. Returns None without it, and logs once."""
    if arch == "cpu" or arch in _missing:
        return None
    link = _links.get(arch)
    if link is None or link.has_ended:
        try:
            link = _links[arch] = DeviceLink(arch)
        except DeviceLost as error:
            _missing.add(arch)
            log.warning("%s; keyframes are fused on the CPU", error)
            return None
    return link


def refuse(link: DeviceLink, why: str) -> None:
    """Use the CPU for all maps of this process from now on, and log the reason."""
    link.close()
    _missing.add(link.arch)
    log.warning("the device %s cannot be used: %s; keyframes are fused on the CPU", link.arch, why)
