"""The differentiable picture in plain torch, gradients by autograd: slow, and what the kernels must agree with."""

import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from pytest import MonkeyPatch
from torch import Tensor

from usdfab.fit.raster import jumps, renderer as renderer_module, rims
from usdfab.fit.raster.curves import CurveModel, Polylines
from usdfab.fit.raster.edges import Jumps, Pairs, inside, outside
from usdfab.fit.raster.hits import SIDE, Meeting
from usdfab.fit.raster.jumps import ALONG_ROW, ANY, GAP_P, GAP_Q, P_ENDS, Q_ENDS
from usdfab.fit.raster.renderer import RasterRenderer
from usdfab.fit.raster.segments import Geometry
from usdfab.fit.raster.shade import Look
from usdfab.fit.raster.visibility import NOTHING, Seen, taken
from usdfab.scattering.fiber_torch import eval_fiber, pack_fiber

STEPS, EPSILON = 2, 1e-12
EDGE = 1.0 - 1e-6


class Segments(NamedTuple):
    """Pieces of fibers beside rays that start at the origin: ends and unit tangents (N, 3), radius (N,)."""

    start: Tensor
    end: Tensor
    start_tangent: Tensor
    end_tangent: Tensor
    radius: Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1)


def _cylinder(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    chord = s.end - s.start
    length = torch.sqrt(dot(chord, chord) + EPSILON)
    axis = chord / length[:, None]
    b = dot(direction, axis)
    sin2 = (1.0 - b * b).clamp_min(1e-6)
    middle = (dot(s.start, direction) - b * dot(s.start, axis)) / sin2
    half = s.radius / torch.sqrt(sin2)
    h = dot(s.start, torch.linalg.cross(direction, axis, dim=-1)) / (torch.sqrt(sin2) * s.radius)
    entry = middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0) + EPSILON)
    return h, middle, half, (b * entry - dot(s.start, axis)) / length


def pass_by(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    h, middle, half, along = _cylinder(s, direction)
    past_end = along > 1.0
    center = torch.where(past_end[:, None], s.end, s.start)
    nearest = dot(center, direction)
    aside = center - nearest[:, None] * direction
    distance = torch.sqrt(dot(aside, aside) + EPSILON) / s.radius
    inside = (along >= 0.0) & ~past_end
    return (
        torch.where(inside, h, torch.where(h < 0.0, -distance, distance)),
        torch.where(inside, middle, nearest),
        torch.where(inside, half, s.radius),
    )


def meet(s: Segments, direction: Tensor, side: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """Distance, tangent and h; the distance's root without slope where it is less than ``side``."""
    h, middle, half = pass_by(s, direction)
    h = h.clamp(-1.0, 1.0)
    root = torch.sqrt((1.0 - h * h).clamp_min(0.0) + EPSILON)
    distance = middle - half * torch.where(root > side, root, root.detach())
    chord = s.end - s.start
    hit = distance[:, None] * direction
    u = (dot(hit - s.start, chord) / (dot(chord, chord) + EPSILON)).clamp(0.0, 1.0)[:, None]
    tangent = (1.0 - u) * s.start_tangent + u * s.end_tangent
    tangent = tangent / torch.sqrt(dot(tangent, tangent) + EPSILON)[:, None]
    normal = hit - (s.start + u * chord)
    normal = normal - dot(normal, tangent)[:, None] * tangent
    across = torch.linalg.cross(direction, tangent, dim=-1)
    scale = torch.sqrt(dot(across, across) * dot(normal, normal) + EPSILON)
    return distance, tangent, (-dot(normal, across) / scale).clamp(-1.0, 1.0)


class Reference:
    """What the kernels of a ``RasterRenderer`` do, once more, for a ``Look``. Lengths in units of the geometry."""

    def __init__(self, renderer: RasterRenderer, look: Look) -> None:
        self.renderer, self.look = renderer, look
        self.model: CurveModel = renderer.model

    def instead_of_kernels(self, monkeypatch: MonkeyPatch) -> None:
        for module in (renderer_module, rims):
            monkeypatch.setattr(module, "shadow_edges", self.shadow_edges)
        monkeypatch.setattr(renderer_module, "meet", self.meet)
        monkeypatch.setattr(rims, "sides", lambda *a: self.meet(*a, side=SIDE).distance)
        monkeypatch.setattr(renderer_module, "shaded", self.shaded)
        monkeypatch.setattr(renderer_module, "blended", blended)
        monkeypatch.setattr(jumps, "_crossings", self.crossings)
        monkeypatch.setattr(jumps, "_kinds_of", lambda geometry, points, radius, *rest: self.kinds_of(geometry, *rest))

    def segments(self, geometry: Geometry, lines: Polylines, segment: np.ndarray, copy: np.ndarray, start: np.ndarray):
        """Relative to ``start`` (M, 3)."""
        model, size = self.model, geometry.size
        pad = np.zeros((len(segment), 1))
        shift = np.c_[copy * size, pad] - start
        on = shift + np.c_[model.following_shift[segment] * size, pad]
        first, second = torch.from_numpy(segment), torch.from_numpy(model.following[segment])
        return Segments(
            lines.points[first] / geometry.scale + torch.from_numpy(shift),
            lines.points[second] / geometry.scale + torch.from_numpy(on),
            lines.tangents[first],
            lines.tangents[second],
            (lines.radius / geometry.scale)[torch.from_numpy(model.system[segment])],
        )

    def settled(self, geometry: Geometry, lines: Polylines, seen: Seen, start: np.ndarray, direction: Tensor):
        """Segments and copies beside rays (M, 3) of the fibers that were seen."""
        model, segment, copy = self.model, seen.segment.astype(np.int64), seen.copy.astype(np.int64)
        for _ in range(STEPS):
            along = _cylinder(self.segments(geometry, lines, segment, copy, start), direction)[3].detach().numpy()
            on, back = along > 1.0, along < 0.0
            copy = copy + on[:, None] * model.following_shift[segment]
            copy = copy + back[:, None] * model.preceding_shift[segment]
            segment = np.where(on, model.following[segment], np.where(back, model.preceding[segment], segment))
        return segment, copy

    def passing(self, geometry: Geometry, lines: Polylines, seen: Seen, at: np.ndarray):
        """What ``pass_by`` finds for fibers and the rays of pixels ``at``, with the segments and copies."""
        start, direction = geometry.start[at], torch.from_numpy(geometry.direction[at])
        found = self.settled(geometry, lines, seen, start, direction)
        return *pass_by(self.segments(geometry, lines, *found, start), direction), *found

    def meet(self, geometry: Geometry, lines: Polylines, seen: Seen, side: float = 0.0) -> Meeting:
        n, hit = len(geometry.start), np.flatnonzero(seen.segment != NOTHING)
        s = self.segments(geometry, lines, seen.segment[hit].astype(np.int64), seen.copy[hit], geometry.start[hit])
        rows = torch.from_numpy(hit)
        found = meet(s, torch.from_numpy(geometry.direction)[rows], side)
        shapes = ((n,), (n, 3), (n,))
        return Meeting(
            *(torch.zeros(f, dtype=torch.float64).index_copy(0, rows, x) for f, x in zip(shapes, found, strict=True))
        )

    def depth(self, h: Tensor, axis: Tensor, unit: Tensor) -> Tensor:
        return axis - unit * torch.sqrt((1.0 - h * h).clamp_min(1e-9))

    def profile(self, geometry: Geometry, lines: Polylines, seen: Seen, at: np.ndarray):
        """h, depth of the axis and radius along the rays of pixels ``at``, with the segments and copies."""
        h, middle, half, *found = self.passing(geometry, lines, seen, at)
        down = -torch.from_numpy(geometry.direction[at, 2])
        return h, middle * down, half * down, *found

    def showing(self, geometry: Geometry, lines: Polylines, ends: Seen, other: Seen, at: np.ndarray):
        """The jump function of ``ends`` before ``other``, with the segments and copies of both."""
        h, axis, unit, *found = self.profile(geometry, lines, ends, at)
        solid = np.flatnonzero(other.segment != NOTHING)
        rows = torch.from_numpy(solid)
        *there, segment, copy = self.profile(geometry, lines, taken(other, solid), at[solid])
        sunk = ((axis[rows] - self.depth(*there)) / unit[rows]).clamp_min(0.0)
        sunk = torch.zeros_like(h).index_copy(0, rows, sunk)
        segments, copies = np.full(len(h), NOTHING), np.zeros((len(h), 2), dtype=np.int64)
        segments[solid], copies[solid] = segment, copy
        return torch.sqrt(h * h + sunk * sunk + 1e-12) - 1.0, *found, segments, copies

    def differ(self, seen: Seen, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        model = self.model
        a, b = seen.segment[p].astype(np.int64), seen.segment[q].astype(np.int64)
        copy_a, copy_b = seen.copy[p], seen.copy[q]
        same_copy = (copy_a == copy_b).all(axis=1)
        same = (a == b) & same_copy | (a >= 0) & (b >= 0) & (model.curve[a] == model.curve[b]) & same_copy
        for one, other, of_one, of_other in ((a, b, copy_a, copy_b), (b, a, copy_b, copy_a)):
            next_copy = of_one + model.following_shift[one]
            same |= (one >= 0) & (model.following[one] == other) & (next_copy == of_other).all(axis=1)
        return ~same & ((a >= 0) | (b >= 0))

    def kinds_of(self, geometry: Geometry, seen: Seen, pairs: Pairs, axis: int) -> np.ndarray:
        lines = self.lines

        def counts(values: list[np.ndarray]) -> np.ndarray:
            row, column = abs(values[1] - values[0]), abs(values[2] - values[0])
            return np.full(len(row), True) if axis == ANY else row >= column if axis == ALONG_ROW else row > column

        kinds = np.zeros(len(pairs.p), dtype=np.int8)
        rows = np.flatnonzero(self.differ(seen, pairs.p, pairs.q))
        pairs = pairs[rows]
        nothing_p, nothing_q = (seen.segment[k] == NOTHING for k in (pairs.p, pairs.q))
        a = taken(seen, np.where(nothing_p, pairs.q, pairs.p))
        b = taken(seen, np.where(nothing_q, pairs.p, pairs.q))
        with torch.no_grad():
            places = (pairs.p, pairs.q, pairs.r)
            h_a, h_b = ([self.profile(geometry, lines, s, at)[0] for at in places] for s in (a, b))
            out_a, out_b = (abs(h.numpy()) for h in (h_a[1], h_b[0]))
            apart = (out_a > 1.0) & (out_b > 1.0) & ~nothing_p & ~nothing_q
            end_a, end_b = (crossing(h[0].abs() - 1.0, h[1].abs() - 1.0).numpy() for h in (h_a, h_b))
            gap = apart & (end_a < end_b)
            depth_a, depth_b = (
                self.depth(*self.profile(geometry, lines, s, at)[:3]).numpy() for s, at in ((a, pairs.p), (b, pairs.q))
            )
            a_ends = np.where(apart, depth_a <= depth_b, out_a > out_b)
            a_ends = nothing_q | ~nothing_p & a_ends
            ends, other = (
                taken(seen, np.where(a_ends, *of)) for of in ((pairs.p, pairs.q), (pairs.q, pairs.p))
            )  # fmt: skip
            shown = [self.showing(geometry, lines, ends, other, at)[0].numpy() for at in places]
        plain = np.where(counts(shown), np.where(a_ends, P_ENDS, Q_ENDS), 0)
        wide = sum(
            np.where(counts([h.abs().numpy() for h in each]), bit, 0) for each, bit in ((h_a, GAP_P), (h_b, GAP_Q))
        )
        kinds[rows] = np.where(gap, wide, plain)
        return kinds

    def crossings(self, geometry: Geometry, lines: Polylines, seen: Seen, pairs: Pairs, kinds: np.ndarray, alone: bool):
        ends = taken(seen, np.where(kinds == P_ENDS, pairs.p, pairs.q))
        other = taken(seen, np.where(kinds == P_ENDS, pairs.q, pairs.p))
        if alone:
            other = replace(other, segment=np.full(len(kinds), NOTHING))
        first, second = (self.showing(geometry, lines, ends, other, at) for at in (pairs.p, pairs.q))
        segments = np.stack([first[1], second[1], first[3], second[3]])
        copies = np.stack([first[2], second[2], first[4], second[4]])
        return crossing(first[0], second[0]), (segments, copies)

    def shadow_edges(
        self, geometry: Geometry, lines: Polylines, distance: Tensor, shines: Tensor, seen: Seen, shadow: Seen, lamp,
        pairs: Pairs, along_row: bool, reach=None,
    ):  # fmt: skip
        dark = shadow.segment != NOTHING
        reach = np.ones(len(pairs.p)) if reach is None else reach
        chosen = (dark[pairs.p] != dark[pairs.q]) & (seen.segment[pairs.p] != NOTHING)
        chosen &= ~self.differ(seen, pairs.p, pairs.q)
        pairs, reach = pairs[chosen], torch.from_numpy(reach[chosen])
        owner, lit = np.where(dark[pairs.p], pairs.p, pairs.q), np.where(dark[pairs.p], pairs.q, pairs.p)

        def cast(at: np.ndarray, far: Tensor, caster: np.ndarray) -> Tensor:
            place = far[:, None] * torch.from_numpy(geometry.direction[at])
            to_lamp = torch.from_numpy(lamp / geometry.scale - geometry.start[at]) - place
            to_lamp = to_lamp / torch.linalg.norm(to_lamp, dim=-1, keepdim=True)
            origin = geometry.start[at] + place.detach().numpy()
            found = self.settled(geometry, lines, taken(shadow, caster), origin, to_lamp.detach())
            s = self.segments(geometry, lines, *found, origin)
            rest = place - place.detach()
            return pass_by(s._replace(start=s.start - rest, end=s.end - rest), to_lamp)[0]

        with torch.no_grad():
            h, middle, half, _, _ = self.passing(geometry, lines, taken(seen, pairs.p), pairs.r)
            aside = middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0) + EPSILON)
            here, there, beyond = (
                cast(at, distance[torch.from_numpy(at)], owner) for at in (pairs.p, pairs.q, lit)
            )  # fmt: skip
            row, column = (there - here).abs() / reach, (cast(pairs.r, aside, owner) - here).abs()
            keep = (row >= column if along_row else row > column).numpy()
            sign = torch.sign(beyond)[torch.from_numpy(keep)]
        pairs, owner = pairs[keep], owner[keep]
        at_p, at_q = (sign * cast(at, distance[torch.from_numpy(at)], owner) - 1.0 for at in (pairs.p, pairs.q))
        t = crossing(at_p, at_q)
        step = shines[torch.from_numpy(outside(pairs, t))] - shines[torch.from_numpy(inside(pairs, t))]
        return [Jumps(pairs, t, step)]

    def shaded(self, geometry: Geometry, seen: Seen, met: Meeting, lit: Tensor, *_) -> Tensor:
        """(N, 3) of all lamps."""
        view, settings, hit = self.renderer._view, self.renderer.settings, np.flatnonzero(seen.segment != NOTHING)
        rows, segment = torch.from_numpy(hit), seen.segment[hit].astype(np.int64)
        direction, distance, lit = torch.from_numpy(geometry.direction[hit]), met.distance[rows], lit[rows]
        spread = self.renderer._pixel * geometry.scale / self.lines.radius[torch.from_numpy(self.model.system[segment])]
        total = torch.zeros(len(hit), 3, dtype=torch.float64)
        for k, lamp in enumerate(view.lamps):
            to_lamp = torch.from_numpy(lamp / geometry.scale - geometry.start[hit]) - distance[:, None] * direction
            rest = settings.unshadowed
            for part, shines in (("single", lit[:, k]), ("diffuse", rest + (1.0 - rest) * lit[:, k])):
                if getattr(settings, part):
                    light = self._shaded(part, segment, met.tangent[rows], met.h[rows], direction, spread, to_lamp)
                    intensity = torch.from_numpy(view.intensity[k] / geometry.scale**2)
                    total = total + light * shines[:, None] * intensity
        return torch.zeros(len(seen.segment), 3, dtype=torch.float64).index_add(0, rows, total)

    @property
    def lines(self) -> Polylines:
        """Those of the picture that is being made."""
        return self._lines

    def image(self, shapes) -> Tensor:
        """(H, W, 3) of the renderer, without kernels."""
        self._lines = self.model(shapes)
        with MonkeyPatch.context() as patch:
            self.instead_of_kernels(patch)
            pixels = self.renderer.pixels(self._lines, self.look)
        height, width = self.renderer._shape
        m = self.renderer.settings.supersampling
        return pixels.reshape(height // m, m, width // m, m, 3).mean(dim=(1, 3))

    def _shaded(self, part: str, segment, tangent, h, ray, spread, offset) -> Tensor:
        """Single scattering or diffuse light of pieces of equal angle, over the squared distance."""
        fabric, look_ = self.renderer.fabric, self.look
        squared = dot(offset, offset)
        to_lamp = offset / torch.sqrt(squared)[:, None]
        total = torch.zeros(len(h), 3, dtype=torch.float64)
        for row in range(len(look_.albedo)):
            for number in range(1, 9):
                low, high = (torch.asin((h + side * spread).clamp(-EDGE, EDGE)) for side in (-0.5, 0.5))
                count = torch.ceil((high - low).detach() / 0.45).clamp_min(1.0)
                mine = torch.from_numpy(self.model.color[segment] == row) & (count == number)
                if not mine.any():
                    continue
                k = int(self.model.system[segment[int(mine.nonzero()[0])]])
                tilt = fabric.system("weft" if k else "warp").cuticle_tilt
                material = pack_fiber(look_.albedo[row], *look_.roughness[k], look_.ior[k], tilt)
                low, high = low[mine], high[mine]
                bounds = [torch.sin(low + (high - low) * (j / number)) for j in range(number + 1)]
                light = torch.zeros(len(low), 3, dtype=torch.float64)
                for a, b in itertools.pairwise(bounds):
                    piece = _radiance(
                        material if part == "single" else None, look_.diffuse[row] if part == "diffuse" else None,
                        tangent[mine], 0.5 * (a + b), ray[mine], b - a, to_lamp[mine],
                    )  # fmt: skip
                    light = light + ((b - a) / (bounds[-1] - bounds[0]))[:, None] * piece
                total = total.index_add(0, mine.nonzero()[:, 0], light / squared[mine, None])
        return total


def _radiance(material, diffuse, tangent, h, ray, spread, to_lamp) -> Tensor:
    sin_to, sin_ti = -dot(ray, tangent), dot(to_lamp, tangent)
    f = torch.linalg.cross(ray, tangent, dim=-1)
    f = f / torch.sqrt(dot(f, f) + 1e-12)[:, None]
    e = torch.linalg.cross(f, tangent, dim=-1)
    along_e, along_f = dot(to_lamp, e), dot(to_lamp, f)
    result = torch.zeros((), dtype=ray.dtype)
    if material is not None:
        cos_to = torch.sqrt((1.0 - sin_to**2).clamp_min(1e-8))
        cos_ti = torch.sqrt((along_e**2 + along_f**2).clamp_min(1e-8))
        phi = torch.atan2(along_f, torch.where(along_e.abs() + along_f.abs() > 1e-6, along_e, 1e-6))
        result = result + eval_fiber(material, h, sin_to, cos_to, sin_ti, cos_ti, phi, spread)
    if diffuse is not None:
        fiber_cos = (torch.sqrt(1.0 - h**2) * along_e - h * along_f).clamp_min(0.0)
        cosine = 0.5 * fiber_cos + 0.5 * to_lamp[:, 2].clamp_min(0.0)
        result = result + diffuse * (cosine / math.pi)[:, None]
    return result


def crossing(at_p: Tensor, at_q: Tensor) -> Tensor:
    difference = at_q - at_p
    safe = torch.where(difference.abs() > 1e-9, difference, torch.full_like(difference, 1e-9))
    return (-at_p / safe).clamp(0.0, 1.0)


def blended(values: Tensor, parts) -> Tensor:
    result = values
    for part in parts:
        target = torch.where(part.t < 0.5, torch.from_numpy(part.pairs.p), torch.from_numpy(part.pairs.q))
        result = result.index_add(0, target, (0.5 - part.t).abs()[:, None] * part.step)
    return result
