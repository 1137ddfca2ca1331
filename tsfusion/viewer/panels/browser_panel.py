# SPDX-License-Identifier: MIT
"""Build the controls of one browser: colours, cut, camera, measuring, pictures and downloads."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.viewer.map import map_views
from tsfusion.viewer.map.clipping import ClippingControls
from tsfusion.viewer.map.map_views import PageCamera
from tsfusion.viewer.map.tile_nodes import MOST_UNREAD, OwnLook, TileLook
from tsfusion.viewer.page.page_server import calm
from tsfusion.viewer.panels.health_plots import text

if TYPE_CHECKING:
    import viser

    from tsfusion.geometry.mesh import Mesh

WHOLE, BY_HAND, _FOLLOW = "Whole map", "By hand", "Follow "
_SLOWEST_S = 10.0  # seconds after our move, in which a slow browser may still report old positions
_AGAIN = 1.0  # seconds after which a camera turned by a new up direction is moved again
_MOVED = 0.02  # share of the distance to the target; a larger shift means that a person moved the camera
_RENDER = 30.0  # seconds that a browser may take for a picture
# Width / height of a phone. Up to 576 points of width viser puts the panel over the lower half of the
# picture; but a browser tells pixels: a phone has two or three a point, one that draws slowly three quarters.
_UPRIGHT = 0.6
_COVERED = 0.5
_MARK = (213, 94, 0)


class ShownPage(Protocol):
    """Interface of `LivePage` for a browser's panel."""

    map_name: str
    shared: TileLook

    def scanners(self) -> list[tuple[bytes, str]]: ...
    def whole_view(self, aspect: float, covered: float) -> PageCamera | None: ...
    def scanner_view(self, session: bytes) -> PageCamera | None: ...
    def new_look(self, client: "viser.ClientHandle") -> OwnLook: ...
    def shown_mesh(self, look: TileLook) -> "Mesh": ...
    def hit(
        self, look: TileLook, origin: NDArray[np.float64], direction: NDArray[np.float64]
    ) -> NDArray[np.float64] | None: ...


class BrowserPanel:
    """Controls of one browser.

    Args:
        view, cut: context managers; controls that are made in them appear in this part of the page.
        modes: names of colourings; the first is chosen.

    Attributes:
        own: tiles and colours of this browser; None = it shows the shared ones.
        is_changed: True if a person has changed a control since `change_look`.
    """

    def __init__(
        self,
        client: "viser.ClientHandle",
        shown: ShownPage,
        view: AbstractContextManager[Any],
        cut: AbstractContextManager[Any],
        modes: Sequence[str],
    ) -> None:
        self._client, self._shown = client, shown
        self._commanded: PageCamera | None = None
        self._moved_at = self._sent_at = 0.0
        self._is_elsewhere = False  # the browser reports another camera position than ours
        self._has_arrived = False  # the browser has reported our camera position
        self._points: list[NDArray[np.float64]] = []
        self._marks: list[Any] = []
        self._saving = threading.Lock()
        self._is_measuring = False
        self.own: OwnLook | None = None
        self.is_changed = False
        gui = client.gui
        with cut:
            self._clipping = ClippingControls(gui, self._note_change)
        with view:
            self._mode: Any = gui.add_dropdown("Colour", tuple(modes), initial_value=modes[0])
            self._legend = gui.add_html("", visible=False)
            self._camera: Any = gui.add_dropdown("Camera", (WHOLE, BY_HAND), initial_value=WHOLE)
            self._measure = gui.add_button("Measure a distance", hint="Click two points of the surface")
            self._answer = gui.add_html("", visible=False)
            picture = gui.add_button("Save picture")
            model = gui.add_button("Save 3-D model", hint="GLB of what is shown: cut, and in these colours")
            dark = gui.add_checkbox("Dark", False)
        self._mode.on_update(calm(lambda event: self._note_change()))
        self._camera.on_update(calm(lambda event: self._forget_view()))
        self._measure.on_click(calm(lambda event: self._toggle_measuring()))
        picture.on_click(calm(lambda event: self._save_one(self._save_picture)))
        model.on_click(calm(lambda event: self._save_one(self._save_model)))
        dark.on_update(calm(lambda event: set_theme(client.gui, dark=dark.value)))
        client.camera.fov = map_views.FOV
        client.camera.on_update(calm(lambda event: self._note_move()))

    @property
    def _look(self) -> TileLook:
        return self.own or self._shown.shared

    def _note_change(self) -> None:
        self.is_changed = True

    def change_look(self) -> None:
        """Apply the colour and clip controls: a browser with other choices gets tiles of its own."""
        self.is_changed = False
        mode, clipping, shared = self._mode.value, self._clipping.clipping, self._shown.shared
        if mode == shared.colors.mode and clipping.normal is None and clipping.box is None:
            own, self.own = self.own, None
            if own is not None:
                own.close()
        else:
            if self.own is None:
                self.own = self._shown.new_look(self._client)
                self.own.choose(mode)
            elif mode != self.own.colors.mode:
                self.own.choose(mode)
            self.own.nodes.clip(clipping)
        self._tell_legend()

    def fit(self, low: NDArray[np.float64], high: NDArray[np.float64], up: NDArray[np.float64]) -> None:
        """Fit the clip sliders and the legend to a map from (3,) `low` to (3,) `high`, metres."""
        self._clipping.fit(low, high, up)
        self._tell_legend()

    def send(self, now: float) -> None:
        """Send changed tiles to a browser that has tiles of its own."""
        if self.own is not None:
            with self._client.atomic():
                self.own.send(now)

    def _tell_legend(self) -> None:
        legend = self._look.colors.legend()
        self._legend.content, self._legend.visible = text(legend), bool(legend)

    def update(self) -> None:
        """Move the camera with the map or scanner that it follows, and list the present scanners."""
        names = (WHOLE, BY_HAND, *dict.fromkeys(_FOLLOW + name for _, name in self._shown.scanners()))
        if tuple(self._camera.options) != names:
            self._camera.options = names
        view, now = self._wanted(), time.monotonic()
        if view is None:
            return
        if self._differs(view):
            self._commanded, self._moved_at = view, now
        elif not self._is_elsewhere or now < self._sent_at + _AGAIN:
            return
        view = self._commanded
        assert view is not None
        self._sent_at, self._has_arrived, self._is_elsewhere = now, False, False
        with self._client.atomic():
            self._client.camera.position = view.position
            self._client.camera.look_at = view.target
            self._client.camera.up_direction = view.up
        self._has_arrived = False  # a callback may have set it during our move

    def _wanted(self) -> PageCamera | None:
        if self._camera.value == WHOLE:
            camera = self._client.camera
            covered = _COVERED if camera.aspect < _UPRIGHT else 0.0
            return self._shown.whole_view(camera.aspect, covered)
        for session, name in self._shown.scanners():
            if self._camera.value == _FOLLOW + name:
                return self._shown.scanner_view(session)
        return None

    def _differs(self, view: PageCamera) -> bool:
        before = self._commanded
        if before is None:
            return True
        share = 0.05 if self._camera.value == WHOLE else 0.005
        most = share * float(np.linalg.norm(view.position - view.target))
        shifts = [float(np.linalg.norm(a - b)) for a, b in zip(view, before, strict=True)]
        return max(shifts[:2]) > most or shifts[2] > share

    def _forget_view(self) -> None:
        self._commanded = None

    def _note_move(self) -> None:
        """Stop following the map or scanner if a person has moved the camera."""
        view = self._commanded
        if view is None or self._camera.value == BY_HAND:
            return
        distance = float(np.linalg.norm(view.position - view.target))
        if float(np.linalg.norm(self._client.camera.position - view.position)) <= _MOVED * distance:
            self._has_arrived, self._is_elsewhere = True, False
        elif self._has_arrived or time.monotonic() >= self._moved_at + _SLOWEST_S:
            self._camera.value, self._is_elsewhere = BY_HAND, False
        else:
            self._is_elsewhere = True

    def _toggle_measuring(self) -> None:
        self._is_measuring = not self._is_measuring
        self._measure.label = "End measuring" if self._is_measuring else "Measure a distance"
        self._forget_points()
        if self._is_measuring:
            self._tell("Click two points of the surface.")
            self._client.scene.on_click()(calm(self._click))
        else:
            self._client.scene.remove_click_callback("all")
            self._answer.visible = False

    def _click(self, event: Any) -> None:
        point = self._shown.hit(self._look, np.array(event.ray_origin), np.array(event.ray_direction))
        if point is None:
            self._tell("There is no surface.")
            return
        if len(self._points) == 2:
            self._forget_points()
        self._points.append(point)
        self._mark(point)
        if len(self._points) == 2:
            self._mark_distance()
        else:
            self._tell("Click the second point.")

    def _mark(self, point: NDArray[np.float64]) -> None:
        radius = 0.006 * float(np.linalg.norm(point - self._client.camera.position))
        name = f"/measured/{len(self._points)}"
        self._marks.append(self._client.scene.add_icosphere(name, radius, color=_MARK, position=point))

    def _mark_distance(self) -> None:
        a, b = self._points
        length = float(np.linalg.norm(b - a))
        name = f"{length:.3f} m" if length >= 1 else f"{100 * length:.1f} cm"
        scene = self._client.scene
        line = np.array([[a, b]], np.float32)
        self._marks.append(
            scene.add_line_segments("/measured/line", line, _MARK, thickness=3.0, thickness_units="screen")
        )
        self._marks.append(
            scene.add_label("/measured/label", name, position=(a + b) / 2, anchor="bottom-center")
        )
        dx, dy, dz = (b - a).tolist()
        self._tell(f"<b>{name}</b> &nbsp; x {dx:+.3f}, y {dy:+.3f}, z {dz:+.3f} m")

    def _forget_points(self) -> None:
        self._points.clear()
        for mark in self._marks:
            mark.remove()
        self._marks.clear()

    def _tell(self, content: str) -> None:
        self._answer.content, self._answer.visible = text(content), True

    def _save_one(self, save: Callable[[], None]) -> None:
        """Call `save`, one file at a time: only once the browser has taken the last file."""
        waiting = self._client._websock_connection.get_message_buffer().message_from_id
        if len(waiting) > MOST_UNREAD or not self._saving.acquire(blocking=False):
            return
        try:
            save()
        finally:
            self._saving.release()

    def _save_picture(self) -> None:
        import cv2

        camera = self._client.camera
        height, width = camera.image_height, camera.image_width
        image = self._client.get_render(height, width, transport_format="png", timeout=_RENDER)
        alpha = image[..., 3:].astype(np.float32) / 255
        flat = np.rint(image[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
        done, content = cv2.imencode(".png", flat[..., ::-1])
        if done:
            self._send("png", bytes(content.tobytes()))

    def _save_model(self) -> None:
        self._send("glb", self._shown.shown_mesh(self._look).encode(".glb"))

    def _send(self, kind: str, content: bytes) -> None:
        stamp = time.strftime("%Y%m%d_%H%M%S")
        name = f"{self._shown.map_name or 'map'}_{stamp}.{kind}"
        self._client.send_file_download(name, content, save_immediately=True)


def set_theme(gui: "viser.GuiApi", *, dark: bool) -> None:
    """Choose a light or dark theme, without viser's logo and buttons."""
    gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, control_width="medium")
