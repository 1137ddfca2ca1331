# SPDX-License-Identifier: MIT
"""Run Taichi on a GPU in a separate process: `python -m tsfusion.tsdf.device.device_process`.

Taichi allows one device per process. Readers of maps (meshes, the field, questions) use the CPU, in the
parent process. `device_link` starts this process, and holds the other end of the connection.
"""

import signal
import socket
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from tsfusion.core import process
from tsfusion.core.errors import MissingDependency
from tsfusion.core.shared_arrays import MOST_SAID, SharedArrays, SharedSlot, look_out
from tsfusion.kernels.base import runtime
from tsfusion.kernels.device import device_copies
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES

if TYPE_CHECKING:
    from tsfusion.tsdf.device.device_link import SentArray
    from tsfusion.tsdf.device.device_map import DeviceMap

NEXT_S = 0.001  # usual time until the next call, while keyframes follow each other
GROWS = ("make", "insert")  # calls that can fail for lack of memory, and then change nothing


class _Device:
    """Main loop of the GPU process: receives calls for maps, by number, and sends the answers."""

    def __init__(self, link: socket.socket, requests: SharedArrays, replies: SharedArrays) -> None:
        self._link, self._requests, self._replies = link, requests, replies
        self._copies = device_copies.copies()
        self._pinned = 0  # address of the pinned memory of requests
        self._maps: dict[int, DeviceMap] = {}

    def run(self) -> None:
        with suppress(OSError):
            while True:
                look_out(self._link.fileno(), NEXT_S)
                said = self._link.recv(MOST_SAID)
                if not said:
                    return
                number, steps = msgspec.msgpack.decode(said)
                answer: tuple[str, Any] = "done", None
                for step in steps:
                    answer = self._answer(number, *step)
                    if answer[0] != "done":
                        break
                self._link.send(msgspec.msgpack.encode(answer))

    def _answer(self, number: int, verb: str, given: list[Any], arrays: list["SentArray"]) -> tuple[str, Any]:
        self._replies.begin()
        for i, dtype, shape, where in arrays:
            if isinstance(where, int):
                given[i] = self._requests.read(SharedSlot(where, shape, dtype))
            else:
                given[i] = np.ndarray(shape, dtype, where)
        memory = self._requests.memory
        if len(memory) and memory.ctypes.data != self._pinned:
            self._pinned = memory.ctypes.data
            self._copies.pin(memory)
        try:
            return "done", self._do(number, verb, given)
        except (RuntimeError, MemoryError) as error:
            return "memory" if verb in GROWS else "failed", runtime.first_line(error)

    def _do(self, number: int, verb: str, given: list[Any]) -> Any:
        if verb == "make":
            from tsfusion.tsdf.device.device_map import DeviceMap

            self._maps[number] = DeviceMap(given[0], self._copies)
            return None
        if verb == "forget":
            self._maps.pop(number, None)
            return None
        if verb == "read":
            return self._read(self._maps[number], *given)
        found = getattr(self._maps[number], verb)(*given)
        if isinstance(found, np.ndarray):
            found = (found,)
        return self._replies.write(found) if isinstance(found, tuple) else found

    def _read(self, one: "DeviceMap", names: list[str], slots: Any) -> list[SharedSlot]:
        places = []
        for name in names:
            rows, place = self._replies.empty((len(slots), CUBE), LAYER_DTYPES[name])
            one.read(name, slots, rows)
            places.append(place)
        return places


def main() -> None:
    """Serve one connection. Command-line arguments: file descriptors of the connection and both shared
    memories, the device, and a flag. With flag `1`, the process ends with the thread that started it."""
    link, requests, replies = (int(argument) for argument in sys.argv[1:4])
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the parent process decides when this process ends
    if sys.argv[5] == "1":
        process.on_parent_end(signal.SIGKILL)
    process.end_first()
    process.lift_memory_limit()  # the limit also counts memory that a driver maps
    connection = socket.socket(fileno=link)
    try:
        runtime.start_device(sys.argv[4])
    except MissingDependency as error:
        connection.send(msgspec.msgpack.encode(("failed", str(error))))
        return
    connection.send(msgspec.msgpack.encode(("done", None)))
    _Device(connection, SharedArrays(requests), SharedArrays(replies)).run()


if __name__ == "__main__":
    main()
