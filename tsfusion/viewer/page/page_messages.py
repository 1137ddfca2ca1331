# SPDX-License-Identifier: MIT
"""Check the messages of browsers: camera, click, picture, or a new value of a control.

viser accepts more message types than our page uses, keeps some data, and trusts the values. So each message
is decoded as one of these types and encoded again; any other message ends its connection.
"""

import math
from collections.abc import Callable
from itertools import chain
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, ValidationError, msgpack

_MOST_PIXELS = 1 << 25  # of a picture: 8K has less
_MOST_BYTES = 4096  # of a message without a picture
_FAR = 1e12  # largest number, metres or other
_PNG_SIZE = slice(16, 24)  # bytes of width and height, big-endian

_PixelCount = Annotated[int, Meta(ge=0, le=1 << 16)]
_Vector = tuple[float, float, float]


class _FromBrowser(Struct, tag_field="type", forbid_unknown_fields=True):
    """Message that viser's page sends from a browser."""


class _CameraMoved(_FromBrowser, tag="ViewerCameraMessage"):
    wxyz: tuple[float, float, float, float]
    position: _Vector
    fov: float
    near: float
    far: float
    image_height: _PixelCount
    image_width: _PixelCount
    look_at: _Vector
    up_direction: _Vector


class _Click(_FromBrowser, tag="ScenePointerMessage"):
    event_type: Literal["click"]
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: tuple[tuple[float, float]]
    modifier: str | None


class _PictureTaken(_FromBrowser, tag="GetRenderResponseMessage"):
    payload: bytes
    render_uuid: str


class _Updates(Struct, forbid_unknown_fields=True):
    value: bool | int | float | str | list[float]  # msgspec 0.21 ends the process for bounds or a tuple here


class _NewValue(_FromBrowser, tag="GuiUpdateMessage"):
    uuid: str
    updates: _Updates


_decoder = msgpack.Decoder(_CameraMoved | _Click | _PictureTaken | _NewValue)


def checked(message: str | bytes, control: Callable[[str], Any]) -> bytes | None:
    """Return the safe form of a browser's message for viser, or None if viser must not get it.

    `control`: returns the present control of a name, or None. Raises msgspec.MsgspecError, RecursionError or
    TypeError for a message that no page of ours sends.
    """
    read = _decoder.decode(message)  # type: ignore[arg-type]  # TypeError for text
    if len(message) > _MOST_BYTES and not isinstance(read, _PictureTaken):
        raise ValidationError(f"a message of {len(message)} bytes (at most {_MOST_BYTES})")
    match read:
        case _NewValue():
            value = _fitted(read.updates.value, control(read.uuid))
            if value is None:
                return None
            read.updates.value = value
        case _PictureTaken():
            width, height = (int.from_bytes(read.payload[_PNG_SIZE][i : i + 4], "big") for i in (0, 4))
            if width * height > _MOST_PIXELS:
                return None
        case _CameraMoved():
            places = (read.wxyz, read.position, read.look_at, read.up_direction)
            numbers = (read.fov, read.near, read.far, *chain.from_iterable(places))
            if not _are_usual(numbers) or not 0 < read.image_height * read.image_width <= _MOST_PIXELS:
                return None
        case _Click():
            if not _are_usual((*read.ray_origin, *read.ray_direction, *read.screen_pos[0])):
                return None
    return msgpack.encode(read)


def _fitted(value: Any, control: Any) -> Any:
    """Return a browser's `value` limited to the bounds of its control; None if the control cannot take it."""
    before = getattr(control, "value", None)
    if isinstance(before, bool) or isinstance(value, bool):  # a box, or a button
        return value if isinstance(before, bool) and isinstance(value, bool) else None
    if hasattr(control, "options"):
        return value if value in control.options else None
    numbers, places = (tuple(one) if isinstance(one, (list, tuple)) else (one,) for one in (value, before))
    if not (hasattr(control, "min") and len(numbers) == len(places) and _are_usual(numbers)):
        return None
    within = tuple(min(max(number, control.min), control.max) for number in numbers)
    return list(within) if isinstance(before, tuple) else within[0]


def _are_usual(numbers: tuple[Any, ...]) -> bool:
    return all(isinstance(one, (int, float)) and math.isfinite(one) and abs(one) <= _FAR for one in numbers)
