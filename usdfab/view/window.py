"""A window that shows pictures which somebody else draws, with mouse, keys and sliders.

While something moves, pictures are drawn smaller, so that they follow the hand; when it rests, in full.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.view.gl import check_display, check_off_screen, pyvista, quiet_vtk

Drag = Literal["turn", "pan", "light"]

REST = 0.25
"""Seconds without a movement after which a picture is drawn in full."""

COARSEST = 4
"""Pictures of moving things are at most so many times smaller."""

GOAL = 0.1
"""Seconds that a picture of moving things may take."""

TICK = 50
"""Milliseconds between looks at the clock."""

INK = (0.95, 0.95, 0.95)


@dataclass(frozen=True)
class Slider:
    """A number that can be moved between two ends."""

    title: str
    low: float
    high: float
    value: float
    moved: Callable[[float], None]


@dataclass(frozen=True)
class Controls:
    """What the window calls.

    Parameters
    ----------
    draw:
        From a size (width, height) to sRGB codes (height, width, 3) uint8.
    dragged:
        The mouse moved with a button down: what for, and by which fractions of the window to the right and up.
    zoomed:
        The wheel turned: by which factor things shall grow.
    keys:
        By name of the key.
    sliders:
        Down the left side.
    help:
        A line at the window's foot.
    """

    draw: Callable[[tuple[int, int]], NDArray[np.uint8]]
    dragged: Callable[[Drag, float, float], None]
    zoomed: Callable[[float], None]
    keys: Mapping[str, Callable[[], None]]
    sliders: Sequence[Slider]
    help: str


class PictureWindow:
    """The window. ``show`` runs it until it is closed; off screen, events can be sent to ``interactor``."""

    def __init__(self, title: str, size: tuple[int, int], controls: Controls, *, off_screen: bool = False) -> None:
        check_off_screen() if off_screen else check_display()
        from vtkmodules.vtkInteractionStyle import vtkInteractorStyleUser
        from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

        pv = pyvista()
        self.controls, self._step, self._moved_at, self._busy = controls, 1, 0.0, False
        self._full = False
        self._drag: tuple[Drag, int, int] | None = None
        with quiet_vtk():
            self.plotter = pv.Plotter(off_screen=off_screen, window_size=list(size), title=title, lighting="none")
        self._mapper = vtkImageMapper()
        self._mapper.SetColorWindow(255.0)
        self._mapper.SetColorLevel(127.5)
        self._mapper.RenderToRectangleOn()
        actor = vtkActor2D()
        actor.SetMapper(self._mapper)
        actor.GetPosition2Coordinate().SetValue(1.0, 1.0)
        actor.GetProperty().SetDisplayLocationToBackground()
        self.plotter.renderer.AddViewProp(actor)
        self.interactor: Any = self.plotter.iren.interactor
        self.interactor.SetInteractorStyle(vtkInteractorStyleUser())
        self._text = self.plotter.add_text(controls.help, position="lower_left", font_size=8, color=INK)
        self._sliders = [self._slider(k, slider) for k, slider in enumerate(controls.sliders)]
        for event, react in (
            ("LeftButtonPressEvent", self._press), ("MiddleButtonPressEvent", self._press),
            ("RightButtonPressEvent", self._press), ("LeftButtonReleaseEvent", self._release),
            ("MiddleButtonReleaseEvent", self._release), ("RightButtonReleaseEvent", self._release),
            ("MouseMoveEvent", self._move), ("MouseWheelForwardEvent", self._wheel),
            ("MouseWheelBackwardEvent", self._wheel), ("KeyPressEvent", self._key), ("TimerEvent", self._tick),
            ("ConfigureEvent", self._resized),
        ):  # fmt: skip
            self.interactor.AddObserver(event, react)
        self._shown = False
        self.refresh(full=True)
        if off_screen:
            self.plotter.show(auto_close=False, interactive=False)
            self._shown = True

    def show(self) -> None:
        """Run the window until it is closed."""
        self.interactor.Initialize()
        self.interactor.CreateRepeatingTimer(TICK)
        self._shown = True
        self.plotter.show(auto_close=True)

    def close(self) -> None:
        self.plotter.close()

    def pixels(self) -> NDArray[np.uint8]:
        """What the window shows, (H, W, 3)."""
        return np.asarray(self.plotter.screenshot(return_img=True))[..., :3]

    def say(self, text: str) -> None:
        """Show a line instead of the help; an empty one brings the help back."""
        self._text.SetText(0, text or self.controls.help)

    def toggle(self) -> None:
        """Hide or show sliders and text."""
        shown = not self._text.GetVisibility()
        self._text.SetVisibility(shown)
        for slider in self._sliders:
            slider.SetEnabled(shown)
        self._show_now()

    def refresh(self, full: bool = False) -> None:
        """Draw and show a picture: in full, or as small as the hand's speed wants."""
        if self._busy:
            return
        self._busy = True
        try:
            width, height = self.plotter.window_size
            step = 1 if full else self._step
            began = time.perf_counter()
            codes = self.controls.draw((max(width // step, 16), max(height // step, 16)))
            seconds = time.perf_counter() - began
            if not full:
                wanted = step * float(np.sqrt(seconds / GOAL))
                self._step = int(np.clip(round(wanted), 1, COARSEST))
            elif seconds > GOAL and self._step == 1:
                self._step = int(np.clip(np.ceil(np.sqrt(seconds / GOAL)), 1, COARSEST))
            self._put(codes)
            self._full = full or step == 1
        finally:
            self._busy = False
        self._show_now()

    def _show_now(self) -> None:
        if self._shown:
            self.plotter.render_window.Render()

    # --- reactions ---

    def _changed(self) -> None:
        self._moved_at = time.perf_counter()
        self.refresh()

    def _guarded(self, call: Callable[[], None]) -> None:
        """What the person asks for may be impossible: then the window says so and goes on."""
        try:
            call()
            self.say("")
        except UsdfabError as error:
            self.say(" ".join(str(error).split()))
        self._changed()

    def _press(self, _: Any, event: str) -> None:
        x, y = self.interactor.GetEventPosition()
        kind: Drag = "turn"
        if event.startswith("Middle") or self.interactor.GetShiftKey():
            kind = "pan"
        elif event.startswith("Right") or self.interactor.GetControlKey():
            kind = "light"
        self._drag = (kind, x, y)

    def _release(self, *_: Any) -> None:
        self._drag = None

    def _move(self, *_: Any) -> None:
        if self._drag is None:
            return
        kind, x0, y0 = self._drag
        x, y = self.interactor.GetEventPosition()
        if (x, y) == (x0, y0) or self._busy:
            return
        self._drag = (kind, x, y)
        width, height = self.plotter.window_size
        self._guarded(lambda: self.controls.dragged(kind, (x - x0) / width, (y - y0) / height))

    def _wheel(self, _: Any, event: str) -> None:
        self._guarded(lambda: self.controls.zoomed(1.15 if "Forward" in event else 1.0 / 1.15))

    def _key(self, *_: Any) -> None:
        react = self.controls.keys.get(self.interactor.GetKeySym())
        if react is not None:
            self._guarded(react)

    def _resized(self, *_: Any) -> None:
        if self._mapper.GetInput() is not None and not self._busy:
            self._moved_at, self._full = time.perf_counter(), False

    def _tick(self, *_: Any) -> None:
        if not self._full and time.perf_counter() - self._moved_at > REST:
            self.refresh(full=True)

    # --- pictures and sliders ---

    def _put(self, codes: NDArray[np.uint8]) -> None:
        height, width = codes.shape[:2]
        image = pyvista().ImageData(dimensions=(width, height, 1))
        image.point_data["rgb"] = np.ascontiguousarray(codes[::-1]).reshape(-1, 3)
        self._mapper.SetInputData(image)

    def _slider(self, number: int, slider: Slider) -> Any:
        top = 0.97 - 0.1 * number
        made: list[Any] = []

        def name(value: float) -> str:
            return f"{slider.title}   {value:.2f}"

        def moved(value: float) -> None:
            if made:  # it is called once when it is made
                made[0].SetTitleText(name(value))
                self._guarded(lambda: slider.moved(value))

        widget = self.plotter.add_slider_widget(
            moved, (slider.low, slider.high), value=slider.value, title=name(slider.value),
            pointa=(0.02, top), pointb=(0.20, top), title_height=0.018, slider_width=0.02, tube_width=0.003,
            color=INK, title_color=INK, interaction_event="always",
        )  # fmt: skip
        look = widget.GetRepresentation()
        # The value is in the title: above the handle it would lie on the title of the slider above.
        look.ShowSliderLabelOff()
        look.SetSliderLength(0.012)
        look.SetEndCapLength(0.003)
        look.SetEndCapWidth(0.02)
        made.append(look)
        return widget
