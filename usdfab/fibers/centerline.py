"""Yarn centre line: a circular arc blended with a parabola (Li et al. 2024, eq. 5 and 6).

Notation: ``l`` length of the segment in cells, ``y`` position in ``[0, l]``, ``u`` = u_max, ``r`` radius of the arc.
Written against the Python array API: NumPy and torch arrays alike.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

L_MIN, L_MAX = 1.0, 4.0
"""Segment lengths between which arc and parabola are blended; longer floats count as L_MAX."""


def unit_centerline(y: Any, length: Any, inclination: Any) -> Any:
    """Height of the centre line divided by its greatest height: 0 at both ends of the segment, 1 in its middle.

    Parameters
    ----------
    y, length:
        Position in the segment and the segment's length, in cells; broadcast arrays.
    inclination:
        u_max in radians, in (0, pi/2).

    Returns
    -------
    array like ``y``: ``z_hyb / (r - r cos u)`` of Li et al. 2024, eq. 6, without beta.
    """
    xp = array_namespace(y, length)
    u = inclination if hasattr(inclination, "dtype") else xp.asarray(float(inclination), dtype=y.dtype)
    r = length / (2.0 * xp.sin(u))
    offset = y - 0.5 * length  # y - r sin u
    z_cir = xp.sqrt(r * r - offset * offset) - r * xp.cos(u)  # eq. 5, arc
    z_par = offset * offset / (r * length) + 1.0  # eq. 5, parabola
    w = xp.clip((length - L_MIN) / (L_MAX - L_MIN), 0.0, 1.0)
    z_hyb = w * z_cir * z_par + (1.0 - w) * z_cir
    return z_hyb / (r - r * xp.cos(u))
