"""The kernels' functions of one ray and one segment, for many: tensors in, tensors out."""

import numpy as np
import torch
from numba import njit
from raster_reference import Segments
from torch import Tensor

from usdfab.fit.raster import edges, hits, segments
from usdfab.fit.raster.hits import Meeting


@njit
def _pass_by(ends, radius, d):
    result = np.empty((len(ends), 3))
    for k in range(len(ends)):
        e = ends[k]
        result[k, 0], result[k, 1], result[k, 2] = segments.pass_by(
            (e[0], e[1], e[2], e[3], e[4], e[5]), radius[k], d[k, 0], d[k, 1], d[k, 2]
        )
    return result


@njit
def _meet(ends, tangents, radius, d):
    result = np.empty((len(ends), 5))
    for k in range(len(ends)):
        e, t = ends[k], tangents[k]
        result[k, 0], result[k, 1], result[k, 2], result[k, 3], result[k, 4] = hits.meeting(
            (e[0], e[1], e[2], e[3], e[4], e[5]), (t[0], t[1], t[2], t[3], t[4], t[5]), radius[k],
            d[k, 0], d[k, 1], d[k, 2],
        )  # fmt: skip
    return result


def pass_by(s: Segments, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    ends = torch.cat([s.start, s.end], dim=1).numpy()
    return tuple(torch.from_numpy(_pass_by(ends, s.radius.numpy(), direction.numpy())).unbind(dim=1))


def meet(s: Segments, direction: Tensor) -> Meeting:
    ends, tangents = torch.cat([s.start, s.end], dim=1), torch.cat([s.start_tangent, s.end_tangent], dim=1)
    found = torch.from_numpy(_meet(ends.numpy(), tangents.numpy(), s.radius.numpy(), direction.numpy()))
    return Meeting(found[:, 0], found[:, 1:4], found[:, 4])


@njit
def _crossing(at_p, at_q):
    return np.array([edges.crossing(at_p[k], at_q[k]) for k in range(len(at_p))])


def crossing(at_p: Tensor, at_q: Tensor) -> Tensor:
    return torch.from_numpy(_crossing(at_p.double().numpy(), at_q.double().numpy()))
