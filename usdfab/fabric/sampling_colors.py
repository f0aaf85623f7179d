"""Random fiber colours for the wide prior: white, natural, grey, saturated, dark, and how warp and weft share them."""

from __future__ import annotations

import colorsys
from dataclasses import replace

import numpy as np

from usdfab.fabric.fabric import Color, FabricParameters
from usdfab.srgb import srgb_to_linear

LOWEST, HIGHEST = 0.004, 0.985
"""Fiber albedo coefficients stay within: blacker than black dye and whiter than bleached cotton is not found."""

STRIPE_CELLS = 400
"""Most crossings in the repeat of a yarn-dyed cloth."""


def sample_color(rng: np.random.Generator) -> Color:
    """A fiber albedo coefficient: what cloth is dyed, not uniform in the cube."""
    kind = rng.choice(["white", "natural", "grey", "vivid", "dark", "any"], p=[0.13, 0.15, 0.13, 0.24, 0.25, 0.1])
    if kind == "any":
        return _color(rng.uniform(0.0, 1.0, 3))
    if kind == "vivid":
        return _hsv(rng.random(), rng.uniform(0.4, 0.9), rng.uniform(0.3, 0.9))
    if kind == "dark":
        return _hsv(rng.random(), rng.uniform(0.0, 0.8), rng.uniform(0.05, 0.35))
    if kind == "grey":
        return _hsv(rng.random(), rng.uniform(0.0, 0.15), rng.uniform(0.25, 0.85))
    if kind == "natural":
        return _hsv(rng.uniform(0.05, 0.2), rng.uniform(0.1, 0.5), rng.uniform(0.5, 0.95))
    return _hsv(rng.random(), rng.uniform(0.0, 0.12), rng.uniform(0.88, 0.995))


def colored(fabric: FabricParameters, rng: np.random.Generator) -> FabricParameters:
    """``fabric`` in random colours: one, a shade apart, two, or yarn-dyed stripes and checks.

    Stripes repeat within ``STRIPE_CELLS`` crossings together with the weave.
    """
    scheme = rng.choice(["same", "shades", "two", "stripes"], p=[0.38, 0.14, 0.34, 0.14])
    first = sample_color(rng)
    second = first
    if scheme == "shades":
        second = _color(np.asarray(first) ** rng.uniform(0.6, 1.6) * rng.uniform(0.85, 1.1, 3))
    elif scheme != "same":
        second = sample_color(rng)
    warp, weft = replace(fabric.warp, albedo=first), replace(fabric.weft, albedo=second)
    fabric = fabric.with_systems({"warp": warp, "weft": weft})
    if scheme == "stripes":
        which = rng.choice(["warp", "weft", "both"])
        if which != "weft":
            fabric = _striped(fabric, "warp", rng)
        if which != "warp":
            fabric = _striped(fabric, "weft", rng)
    return fabric


def _striped(fabric: FabricParameters, system: str, rng: np.random.Generator) -> FabricParameters:
    yarn = fabric.warp if system == "warp" else fabric.weft
    repeat = fabric.weave.ends if system == "warp" else fabric.weave.picks
    # A multiple of the weave's repeat: other lengths make the repeat of both together long.
    length = repeat * int(rng.integers(1, max(2, round(yarn.count / repeat)) + 1))
    palette = [yarn.albedo, *(sample_color(rng) for _ in range(int(rng.integers(1, 4))))]
    colors: list[Color] = []
    while len(colors) < length:
        colors += [palette[rng.integers(len(palette))]] * int(rng.integers(1, 5))
    striped = replace(yarn, yarn_albedo=tuple(colors[:length]))
    dyed = fabric.with_systems({"warp": striped} if system == "warp" else {"weft": striped})
    picks, ends = dyed.repeat()
    return dyed if picks * ends <= STRIPE_CELLS else fabric


def _hsv(hue: float, saturation: float, value: float) -> Color:
    return _color(srgb_to_linear(np.asarray(colorsys.hsv_to_rgb(hue, saturation, value))))


def _color(values: np.ndarray) -> Color:
    red, green, blue = np.clip(values, LOWEST, HIGHEST)
    return float(red), float(green), float(blue)
