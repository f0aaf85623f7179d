"""Where fibers lie in the cross-section (Li et al. 2024, eq. 7, 8; Zhao et al. 2016; Trunz et al. 2023)."""

from __future__ import annotations

import math
from typing import Any

from array_api_compat import array_namespace

ZETA = 0.137
"""Turns between consecutive fibers, theta_i = 2 pi zeta i (eq. 8)."""

JITTER = 0.1
"""Largest jitter amount: J ~ U(0, 0.1) (eq. 7)."""


def fiber_radius(index: Any, count: int, jitter: Any) -> Any:
    """R_i / e_yarn, the fiber's distance from the yarn's axis before migration (eq. 7).

    ``index`` runs from 1 to ``count``; ``jitter`` is J * S.
    """
    return index**0.3 / count**0.3 + jitter


def migrated_radius(radius: Any, theta: Any, theta0: Any, migration: Any, rate: Any) -> Any:
    """R_i(y): the radius while the fiber wanders between the yarn's inside and outside (eq. 7)."""
    xp = array_namespace(radius, theta, theta0)
    return (1.0 - migration) * radius + 0.5 * migration * radius * (xp.cos(rate * theta + theta0) + 1.0)


def fiber_angle(index: Any) -> Any:
    """theta_i = 2 pi zeta i (eq. 8)."""
    return 2.0 * math.pi * ZETA * index
