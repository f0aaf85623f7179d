"""The differentiable picture in plain torch, gradients by autograd: slow, and what the kernels must agree with."""

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from usdfab.fit.raster.curves import CurveModel, Polylines
from usdfab.fit.raster.edges import Pairs
from usdfab.fit.raster.renderer import RasterRenderer
from usdfab.fit.raster.visibility import NOTHING, Seen, index_patch, look
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


def meet(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distance, tangent and h."""
    h, middle, half = pass_by(s, direction)
    h = h.clamp(-1.0, 1.0)
    distance = middle - half * torch.sqrt((1.0 - h * h).clamp_min(0.0) + EPSILON)
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
    """The picture of a ``RasterRenderer``, once more. Lengths in units of ``scale``."""

    def __init__(self, renderer: RasterRenderer, lines: Polylines) -> None:
        self.renderer, self.lines = renderer, lines
        self.model: CurveModel = renderer.model
        self.geometry = renderer._geometry
        self.scale = self.geometry.scale
        self.directions = torch.from_numpy(self.geometry.direction)
        index = index_patch(self.model, lines.points.detach().numpy(), lines.radius.detach().numpy())
        view = renderer._view
        self.lamps = view.lamps if renderer.settings.shadows else view.lamps[:0]
        self.seen, self.shadows = look(index, view.eye, self.geometry.direction, self.lamps)

    def segments(self, segment: np.ndarray, copy: np.ndarray, start: np.ndarray) -> Segments:
        model, lines, size = self.model, self.lines, np.array(self.model.size)
        pad = np.zeros((len(segment), 1))
        shift = np.c_[copy * size, pad] - start
        on = shift + np.c_[model.following_shift[segment] * size, pad]
        first, second = torch.from_numpy(segment), torch.from_numpy(model.following[segment])
        radius = lines.radius / self.scale
        return Segments(
            (lines.points[first] + torch.from_numpy(shift)) / self.scale,
            (lines.points[second] + torch.from_numpy(on)) / self.scale,
            lines.tangents[first],
            lines.tangents[second],
            radius[torch.from_numpy(model.system[segment])],
        )

    def beside(self, seen: Seen, rows: np.ndarray, start: np.ndarray, direction: Tensor) -> Segments:
        segment, copy = seen.segment[rows].astype(np.int64), seen.copy[rows].astype(np.int64)
        model = self.model
        for _ in range(STEPS):
            along = _cylinder(self.segments(segment, copy, start), direction.detach())[3].detach().numpy()
            on, back = along > 1.0, along < 0.0
            copy = copy + on[:, None] * model.following_shift[segment]
            copy = copy + back[:, None] * model.preceding_shift[segment]
            segment = np.where(on, model.following[segment], np.where(back, model.preceding[segment], segment))
        return self.segments(segment, copy, start)

    def starts(self, at: np.ndarray) -> np.ndarray:
        return self.geometry.start[at] * self.scale

    def jumps(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        model, seen = self.model, self.seen
        a, b = seen.segment[p].astype(np.int64), seen.segment[q].astype(np.int64)
        copy_a, copy_b = seen.copy[p], seen.copy[q]
        same_copy = (copy_a == copy_b).all(axis=1)
        same = (a == b) & same_copy | (a >= 0) & (b >= 0) & (model.curve[a] == model.curve[b]) & same_copy
        for one, other, of_one, of_other in ((a, b, copy_a, copy_b), (b, a, copy_b, copy_a)):
            next_copy = of_one + model.following_shift[one]
            same |= (one >= 0) & (model.following[one] == other) & (next_copy == of_other).all(axis=1)
        return ~same

    def profile(self, of: np.ndarray, at: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        direction = self.directions[torch.from_numpy(at)]
        h, middle, half = pass_by(self.beside(self.seen, of, self.starts(at), direction), direction)
        return h, -middle * direction[:, 2], -half * direction[:, 2]

    def depth(self, of: np.ndarray, at: np.ndarray) -> Tensor:
        h, axis, unit = self.profile(of, at)
        return axis - unit * torch.sqrt((1.0 - h * h).clamp_min(1e-9))

    def showing(self, ends: np.ndarray, other: np.ndarray, at: np.ndarray) -> Tensor:
        h, axis, unit = self.profile(ends, at)
        solid = np.flatnonzero(self.seen.segment[other] != NOTHING)
        rows = torch.from_numpy(solid)
        sunk = ((axis[rows] - self.depth(other[solid], at[solid])) / unit[rows]).clamp_min(0.0)
        sunk = torch.zeros_like(h).index_copy(0, rows, sunk)
        return torch.sqrt(h * h + sunk * sunk + 1e-12) - 1.0

    def classified(self, pairs: Pairs, along_row: bool) -> np.ndarray:
        """(M,) 0 for none, 1 where what p sees ends, 2 where what q sees does."""
        kinds = np.zeros(len(pairs.p), dtype=np.int8)
        rows = np.flatnonzero(self.jumps(pairs.p, pairs.q))
        pairs = pairs[rows]
        nothing_p, nothing_q = (self.seen.segment[k] == NOTHING for k in (pairs.p, pairs.q))
        of_a, of_b = np.where(nothing_p, pairs.q, pairs.p), np.where(nothing_q, pairs.p, pairs.q)
        with torch.no_grad():
            out_a, out_b = (self.profile(of, at)[0].abs().numpy() for of, at in ((of_a, pairs.q), (of_b, pairs.p)))
            depth_a, depth_b = (self.depth(of, of).numpy() for of in (of_a, of_b))
            a_ends = np.where((out_a > 1.0) & (out_b > 1.0), depth_a <= depth_b, out_a > out_b)
            a_ends = nothing_q | ~nothing_p & a_ends
            ends, other = np.where(a_ends, pairs.p, pairs.q), np.where(a_ends, pairs.q, pairs.p)
            at_p, at_q, at_r = (self.showing(ends, other, at).numpy() for at in (pairs.p, pairs.q, pairs.r))
        row, column = abs(at_q - at_p), abs(at_r - at_p)
        kinds[rows] = np.where(row >= column if along_row else row > column, np.where(a_ends, 1, 2), 0)
        return kinds

    def visible_edges(self, pairs: Pairs, along_row: bool) -> tuple[Pairs, Tensor, np.ndarray, np.ndarray]:
        kinds = self.classified(pairs, along_row)
        pairs, kinds = pairs[kinds > 0], kinds[kinds > 0]
        ends, other = np.where(kinds == 1, pairs.p, pairs.q), np.where(kinds == 1, pairs.q, pairs.p)
        t = crossing(*(self.showing(ends, other, at) for at in (pairs.p, pairs.q)))
        smooth = []
        for near, far in ((pairs.p, pairs.before), (pairs.q, pairs.after)):
            alike = (near != far) & ~self.jumps(near, far)
            for shadow in self.shadows:
                alike &= (shadow.segment[near] != NOTHING) == (shadow.segment[far] != NOTHING)
            smooth.append(alike)
        return pairs, t, smooth[0], smooth[1]

    def shadow_edges(self, shadow: Seen, distance: Tensor, lamp: np.ndarray, pairs: Pairs, along_row: bool):
        dark, seen = shadow.segment != NOTHING, self.seen.segment != NOTHING
        pairs = pairs[(dark[pairs.p] != dark[pairs.q]) & seen[pairs.p] & ~self.jumps(pairs.p, pairs.q)]
        owner, lit = np.where(dark[pairs.p], pairs.p, pairs.q), np.where(dark[pairs.p], pairs.q, pairs.p)

        def cast(at: np.ndarray) -> Tensor:
            rows = torch.from_numpy(at)
            place = distance[rows, None] * self.directions[rows]
            to_lamp = torch.from_numpy((lamp - self.starts(at)) / self.scale) - place
            to_lamp = to_lamp / torch.linalg.norm(to_lamp, dim=-1, keepdim=True)
            origin = self.starts(at) + self.scale * place.detach().numpy()
            s = self.beside(shadow, owner, origin, to_lamp)
            rest = place - place.detach()
            return pass_by(s._replace(start=s.start - rest, end=s.end - rest), to_lamp)[0]

        same = ~self.jumps(pairs.p, pairs.r) & seen[pairs.r]
        with torch.no_grad():
            here = cast(pairs.p)
            row, column = (cast(pairs.q) - here).abs(), (cast(np.where(same, pairs.r, pairs.p)) - here).abs()
            keep = (row >= column if along_row else row > column).numpy() & (same | along_row)
            sign = torch.sign(cast(lit))[torch.from_numpy(keep)]
        pairs, owner = pairs[keep], owner[keep]
        flat = np.zeros(len(pairs.p), dtype=bool)
        return pairs, crossing(sign * cast(pairs.p) - 1.0, sign * cast(pairs.q) - 1.0), flat, flat

    def image(self, look_) -> Tensor:
        """(H, W, 3)"""
        renderer, settings = self.renderer, self.renderer.settings
        view, n = renderer._view, len(self.directions)
        hit = np.flatnonzero(self.seen.segment != NOTHING)
        rows = torch.from_numpy(hit)
        segment = self.seen.segment[hit].astype(np.int64)
        s = self.segments(segment, self.seen.copy[hit], self.starts(hit))
        distance, tangent, h = meet(s, self.directions[rows])
        far = torch.zeros(n, dtype=torch.float64).index_copy(0, rows, distance)
        spread = renderer._pixel / s.radius
        flat = torch.zeros(n, 3, dtype=torch.float64)
        for k, lamp in enumerate(view.lamps):
            lit = torch.ones(len(hit), dtype=torch.float64)
            if settings.shadows:
                shines = torch.from_numpy((self.shadows[k].segment == NOTHING).astype(float))[:, None]
                if settings.edges:
                    parts = [
                        self.shadow_edges(self.shadows[k], far, lamp, pairs, along_row)
                        for pairs, along_row in zip(renderer._pairs, (True, False), strict=True)
                    ]
                    shines = blended(shines, parts)
                lit = shines[rows, 0]
            to_lamp = (
                torch.from_numpy((lamp - self.starts(hit)) / self.scale) - distance[:, None] * self.directions[rows]
            )
            intensity = torch.from_numpy(view.intensity[k] / self.scale**2)
            rest = settings.unshadowed
            for part, shines in (("single", lit), ("diffuse", rest + (1.0 - rest) * lit)):
                if getattr(settings, part):
                    light = self._shaded(part, look_, segment, tangent, h, self.directions[rows], spread, to_lamp)
                    flat = flat.index_add(0, rows, light * shines[:, None] * intensity)
        if settings.edges:
            parts = [self.visible_edges(pairs, row) for pairs, row in zip(renderer._pairs, (True, False), strict=True)]
            flat = blended(flat, parts)
        height, width = renderer._shape
        m = settings.supersampling
        return view.gain * look_.gain * flat.reshape(height // m, m, width // m, m, 3).mean(dim=(1, 3))

    def _shaded(self, part: str, look_, segment, tangent, h, ray, spread, offset) -> Tensor:
        """Single scattering or diffuse light of pieces of equal angle, over the squared distance."""
        fabric = self.renderer.fabric
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
    for pairs, t, smooth_p, smooth_q in parts:
        p, q = torch.from_numpy(pairs.p), torch.from_numpy(pairs.q)
        slope_p = torch.from_numpy(smooth_p)[:, None] * (values[p] - values[torch.from_numpy(pairs.before)])
        slope_q = torch.from_numpy(smooth_q)[:, None] * (values[torch.from_numpy(pairs.after)] - values[q])
        slope_p, slope_q = torch.maximum(slope_p, -values[p]), torch.minimum(slope_q, values[q])
        width = (0.5 - t)[:, None]
        at_p = values[q] - slope_q - values[p]
        moved = width * (at_p + (slope_q - slope_p) * (0.5 * (t + 0.5))[:, None])
        towards_p = (width > 0.0) * moved
        result = result.index_add(0, p, towards_p).index_add(0, q, moved - towards_p)
    return result
