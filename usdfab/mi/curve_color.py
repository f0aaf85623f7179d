"""A color for each curve as a Mitsuba texture, `usdfab_curve_color`: yarn colors, differentiable.

    register_curve_color()                                    # once, after mi.set_variant
    mi.load_dict({"type": "bsplinecurve", "filename": "warp.txt", "bsdf": {"type": "usdfab_fiber", "albedo": {
        "type": "usdfab_curve_color", "colors": mi.TensorXf(colors),
        "curve_of_segment": mi.TensorXu(curve_of_segment([12, 12, 9]))}}})

Mitsuba's curves have no attributes of their own, but a hit knows its segment (`si.prim_index`), and segments are
counted through the curves of a file one after the other. A color is not interpolated; parameter: `colors`, (3 n) float.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from usdfab.errors import UsdfabError

__all__ = ["CURVE_COLOR", "curve_of_segment", "register_curve_color"]

CURVE_COLOR = "usdfab_curve_color"

_registered: set[str] = set()


def curve_of_segment(counts: npt.ArrayLike) -> npt.NDArray[np.uint32]:
    """The curve that each segment belongs to: (segments,), for curves of so many control points (curves,).

    A `bsplinecurve` of n control points has n - 3 segments.

    Example
    -------
    >>> curve_of_segment([5, 4]).tolist()
    [0, 0, 1]
    """
    counts = np.asarray(counts, dtype=np.int64)
    if counts.ndim != 1 or not np.all(counts >= 4):
        raise UsdfabError("a cubic curve needs four control points or more", place="counts")
    return np.repeat(np.arange(counts.size, dtype=np.uint32), counts - 3)


def register_curve_color() -> None:
    """Make the texture known to the current variant of Mitsuba; again is harmless."""
    if mi.variant() not in _registered:
        mi.register_texture(CURVE_COLOR, _plugin_class())
        _registered.add(mi.variant())


def _plugin_class() -> type:
    """The texture for the variant that is set."""

    class CurveColor(mi.Texture):
        def __init__(self, props: Any) -> None:
            # Checked before there is an object, as in ``fiber_bsdf``.
            colors = np.array(props["colors"], dtype=np.float32)
            segments = np.array(props["curve_of_segment"], dtype=np.uint32)
            if colors.ndim != 2 or colors.shape[1] != 3:
                raise UsdfabError(f"got an array of shape {colors.shape}, expected (curves, 3)", place="colors")
            if not np.all((colors > 0.0) & (colors <= 1.0)):
                raise UsdfabError("expected values in (0, 1]", place="colors")
            if segments.ndim != 1 or segments.size == 0 or segments.max() >= len(colors):
                raise UsdfabError(f"expected numbers of {len(colors)} curves", place="curve_of_segment")
            super().__init__(props)
            self.colors = mi.Float(colors.ravel())
            self.segments = mi.UInt32(segments)

        def traverse(self, callback: Any) -> None:
            callback.put("colors", self.colors, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            dr.make_opaque(self.colors)

        def eval(self, si: Any, active: Any = True) -> Any:
            curve = dr.gather(mi.UInt32, self.segments, si.prim_index, active)
            return dr.gather(mi.Color3f, self.colors, curve, active)

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return self.eval(si, active)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"CurveColor[colors = {dr.width(self.colors) // 3}]"

    return CurveColor
