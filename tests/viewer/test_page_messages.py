# SPDX-License-Identifier: MIT
"""The messages that a page takes from a browser, and the values that a control gets."""

import math
import struct
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from tsfusion.viewer.page.page_messages import checked

SLIDER = SimpleNamespace(value=0.5, min=0.0, max=1.0)
RANGE = SimpleNamespace(value=(0.0, 1.0), min=0.0, max=1.0)
CHOICE = SimpleNamespace(value="a", options=("a", "b"))
BOX = SimpleNamespace(value=True)
CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 0.9,
    "near": 0.01,
    "far": 1000,
    "image_height": 540,
    "image_width": 960,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
CLICK: dict[str, Any] = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0.0, 0.0, 0.0],
    "ray_direction": [0.0, 0.0, 1.0],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}


def taken(message: Any, control: Any = None) -> Any:
    found = checked(msgspec.msgpack.encode(message), lambda name: control if name == "one" else None)
    return None if found is None else msgspec.msgpack.decode(found)


def new_value(value: Any, name: str = "one") -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": name, "updates": {"value": value}}


@pytest.mark.parametrize(
    ("control", "value", "given"),
    [
        (SLIDER, 0.25, 0.25), (SLIDER, 1, 1), (SLIDER, 1e308, None), (SLIDER, 7.5, 1.0), (SLIDER, -1, 0.0),
        (SLIDER, math.nan, None), (SLIDER, math.inf, None), (SLIDER, "1", None), (SLIDER, [0.0, 1.0], None),
        (SLIDER, True, None), (SLIDER, 2**64 - 1, None),
        (RANGE, [0.2, 0.7], [0.2, 0.7]), (RANGE, [-1, 2], [0.0, 1.0]), (RANGE, [0.5], None),
        (RANGE, [], None),
        (RANGE, [0.0, math.nan], None), (RANGE, 0.5, None), (RANGE, [0.0] * 3, None),
        (CHOICE, "b", "b"), (CHOICE, "c", None), (CHOICE, 1, None), (CHOICE, [1.0], None),
        (BOX, False, False), (BOX, 1, None), (BOX, "x", None),
        (SimpleNamespace(value=""), "text", None),  # a kind of control that the page does not have
    ],
)  # fmt: skip
def test_a_control_gets_values_of_its_kind_within_its_bounds(control: Any, value: Any, given: Any) -> None:
    found = taken(new_value(value), control)
    assert (found and found["updates"]["value"]) == (given if found else None)
    assert (found is None) == (given is None)


def test_a_control_that_is_not_there_gets_nothing() -> None:
    assert taken(new_value(True, "another"), BOX) is None


def test_cameras_clicks_and_pictures_pass() -> None:
    assert taken(CAMERA) == CAMERA
    assert taken(CLICK) == CLICK
    picture = {"type": "GetRenderResponseMessage", "payload": bytes(9000), "render_uuid": "x"}
    assert taken(picture) == picture


@pytest.mark.parametrize(
    "change",
    [
        {"fov": math.nan}, {"near": -math.inf}, {"position": [0.0, 1e13, 0.0]}, {"image_width": 0},
        {"image_width": 60_000, "image_height": 60_000},
    ],
)  # fmt: skip
def test_a_camera_that_is_nowhere_is_passed_over(change: dict[str, Any]) -> None:
    assert taken(CAMERA | change) is None


@pytest.mark.parametrize("field", ["ray_origin", "ray_direction"])
def test_a_click_from_nowhere_is_passed_over(field: str) -> None:
    assert taken(CLICK | {field: [0.0, 1e308, 0.0]}) is None
    assert taken(CLICK | {field: [0.0, math.nan, 0.0]}) is None


def test_a_picture_that_unpacks_to_too_much_is_passed_over() -> None:
    for width, height, passes in ((7680, 4320, True), (1 << 17, 1 << 17, False)):
        head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height)
        message = {"type": "GetRenderResponseMessage", "payload": head, "render_uuid": "x"}
        assert (taken(message) is not None) == passes


@pytest.mark.parametrize(
    "message",
    [
        {"type": "GuiFormDirtyMessage", "uuid": "one"},
        {"type": "GuiFormSubmitMessage", "uuid": "one"},
        {"type": "FileTransferPart", "transfer_uuid": "t", "part": 1, "content": b"x"},
        {"type": "ShareUrlRequest"},
        {"type": "GuiUpdateMessage", "uuid": "one", "updates": {"props": "x"}},
        {"type": "GuiUpdateMessage", "uuid": "one", "updates": {"value": 1, "update_cb": []}},
        {"type": "GuiUpdateMessage", "uuid": "one", "updates": {}},
        new_value("x" * 5000), new_value(True, "x" * 5000), new_value({}), new_value(None), new_value([[1]]),
        CAMERA | {"wxyz": [0.0] * 100_000}, CAMERA | {"wxyz": "1000"}, CAMERA | {"more": 1},
        CLICK | {"event_type": "rect-select"}, CLICK | {"screen_pos": [[0.0, 0.0]] * 2},
        {"type": ["GuiUpdateMessage"]}, {}, [], "text", 1,
    ],
)  # fmt: skip
def test_a_message_of_no_page_of_ours_is_an_error(message: Any) -> None:
    with pytest.raises(msgspec.MsgspecError):
        taken(message, BOX)


@pytest.mark.parametrize("raw", [b"", b"\xc1", b"\x82\xa1a" + b"\x91" * 100_000])
def test_bytes_that_are_no_message_are_an_error(raw: bytes) -> None:
    with pytest.raises((msgspec.MsgspecError, RecursionError)):
        checked(raw, lambda name: BOX)


def test_a_field_that_stands_twice_has_one_meaning() -> None:
    """viser gets what was checked, not what came."""
    twice = b"\x84" + b"".join(
        msgspec.msgpack.encode(one)
        for pair in (
            ("type", "GuiUpdateMessage"),
            ("uuid", "one"),
            ("updates", {"value": False}),
            ("uuid", "two"),
        )
        for one in pair
    )
    found = checked(twice, lambda name: BOX)
    assert found is not None
    assert found.count(b"uuid") == 1
