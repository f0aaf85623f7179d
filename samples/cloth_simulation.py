"""A small cloth simulation: a grid of particles that falls onto a ball and a floor.

Extended position-based dynamics with small steps (XPBD: Macklin et al. 2016; "Small Steps in Physics Simulation":
Macklin et al. 2019): in each step every constraint is projected once. The constraints are yarns that hardly stretch,
a soft shear between warp and weft (which lets woven cloth drape), bending along both yarn directions, the ball, the
floor, and the cloth itself. Nothing is random, nothing depends on threads, and only + - * / and square roots are
used, so the same cloth comes out bit for bit.

Units are metres, kilograms and seconds; z is up, the floor is z = 0. Compliances are in units of ``step^2 / mass``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def project_distance(p, i, j, k, m, rest, compliance, both_ways):
    """Move two particles towards their rest distance. ``compliance`` is in units of 1 / (step^2 w)."""
    dx = p[k, m, 0] - p[i, j, 0]
    dy = p[k, m, 1] - p[i, j, 1]
    dz = p[k, m, 2] - p[i, j, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length < 1e-9 or (not both_ways and length > rest):
        return
    s = (length - rest) / ((2.0 + compliance) * length)
    p[i, j, 0] += s * dx
    p[i, j, 1] += s * dy
    p[i, j, 2] += s * dz
    p[k, m, 0] -= s * dx
    p[k, m, 1] -= s * dy
    p[k, m, 2] -= s * dz


@njit(cache=True)
def project_bending(p, i, j, di, dj, compliance):
    """Straighten three particles in a row: C = |a - 2 b + c|, gradients of length 1, 2, 1."""
    for axis in range(3):
        bend = p[i - di, j - dj, axis] - 2.0 * p[i, j, axis] + p[i + di, j + dj, axis]
        s = bend / (6.0 + compliance)
        p[i - di, j - dj, axis] -= s
        p[i, j, axis] += 2.0 * s
        p[i + di, j + dj, axis] -= s


@njit(cache=True)
def project_elastic(p, spacing, shear, bending):
    """Project every stretch, shear and bending constraint once, in interleaved sets that share no particle."""
    n = p.shape[0]
    for parity in range(2):
        for i in range(n):
            for j in range(parity, n - 1, 2):
                project_distance(p, i, j, i, j + 1, spacing, 0.0, True)
        for i in range(parity, n - 1, 2):
            for j in range(n):
                project_distance(p, i, j, i + 1, j, spacing, 0.0, True)
    diagonal = spacing * math.sqrt(2.0)
    for parity in range(2):
        for i in range(parity, n - 1, 2):
            for j in range(n - 1):
                project_distance(p, i, j, i + 1, j + 1, diagonal, shear, True)
            for j in range(n - 1):
                project_distance(p, i, j + 1, i + 1, j, diagonal, shear, True)
    for offset in range(3):
        for i in range(n):
            for j in range(1 + offset, n - 1, 3):
                project_bending(p, i, j, 0, 1, bending)
        for i in range(1 + offset, n - 1, 3):
            for j in range(n):
                project_bending(p, i, j, 1, 0, bending)


@njit(cache=True)
def project_contacts(p, old, ball, radius, gap, friction):
    """Push particles out of the ball and the floor; Coulomb friction on the sliding since the step began."""
    n = p.shape[0]
    for i in range(n):
        for j in range(n):
            dx = p[i, j, 0] - ball[0]
            dy = p[i, j, 1] - ball[1]
            dz = p[i, j, 2] - ball[2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            depth = radius + gap - distance
            if depth > 0.0 and distance > 1e-9:
                push_out(p, old, i, j, dx / distance, dy / distance, dz / distance, depth, friction)
            if p[i, j, 2] < gap:
                push_out(p, old, i, j, 0.0, 0.0, 1.0, gap - p[i, j, 2], friction)


@njit(cache=True)
def push_out(p, old, i, j, nx, ny, nz, depth, friction):
    """One contact with unit normal (nx, ny, nz)."""
    p[i, j, 0] += depth * nx
    p[i, j, 1] += depth * ny
    p[i, j, 2] += depth * nz
    sx = p[i, j, 0] - old[i, j, 0]
    sy = p[i, j, 1] - old[i, j, 1]
    sz = p[i, j, 2] - old[i, j, 2]
    along = sx * nx + sy * ny + sz * nz
    sx, sy, sz = sx - along * nx, sy - along * ny, sz - along * nz
    slide = math.sqrt(sx * sx + sy * sy + sz * sz)
    if slide > 0.0:
        s = min(1.0, friction * depth / slide)
        p[i, j, 0] -= s * sx
        p[i, j, 1] -= s * sy
        p[i, j, 2] -= s * sz


@njit(cache=True)
def nearby_pairs(p, reach, pairs):
    """Pairs of particles closer than ``reach`` that are not neighbours in the cloth; their number.

    Particles are sorted into cubes of side ``reach`` by counting, then each looks into 27 cubes.
    """
    n = p.shape[0]
    low = np.array([p[:, :, 0].min(), p[:, :, 1].min(), p[:, :, 2].min()])
    size = np.zeros(3, np.int64)
    for axis in range(3):
        size[axis] = int((p[:, :, axis].max() - low[axis]) / reach) + 1
    start = np.zeros(size[0] * size[1] * size[2] + 1, np.int64)
    where = np.zeros(n * n, np.int64)
    for a in range(n * n):
        q = p[a // n, a % n]
        x, y, z = int((q[0] - low[0]) / reach), int((q[1] - low[1]) / reach), int((q[2] - low[2]) / reach)
        where[a] = (z * size[1] + y) * size[0] + x
        start[where[a] + 1] += 1
    start = np.cumsum(start)
    fill = start.copy()
    order = np.zeros(n * n, np.int64)
    for a in range(n * n):
        order[fill[where[a]]] = a
        fill[where[a]] += 1
    count = 0
    for a in range(n * n):
        ai, aj = a // n, a % n
        x, y, z = where[a] % size[0], where[a] // size[0] % size[1], where[a] // (size[0] * size[1])
        for cz in range(max(z - 1, 0), min(z + 2, size[2])):
            for cy in range(max(y - 1, 0), min(y + 2, size[1])):
                for cx in range(max(x - 1, 0), min(x + 2, size[0])):
                    cube = (cz * size[1] + cy) * size[0] + cx
                    for slot in range(start[cube], start[cube + 1]):
                        b = order[slot]
                        bi, bj = b // n, b % n
                        if b <= a or (abs(ai - bi) <= 2 and abs(aj - bj) <= 2):
                            continue
                        dx = p[ai, aj, 0] - p[bi, bj, 0]
                        dy = p[ai, aj, 1] - p[bi, bj, 1]
                        dz = p[ai, aj, 2] - p[bi, bj, 2]
                        if dx * dx + dy * dy + dz * dz < reach * reach and count < pairs.shape[0]:
                            pairs[count, 0], pairs[count, 1], pairs[count, 2], pairs[count, 3] = ai, aj, bi, bj
                            count += 1
    return count


@njit(cache=True)
def simulate(p, spacing, steps, step, shear, bending, ball, radius, gap, thickness, friction, drag, gravity):
    """Move the cloth ``p`` (n, n, 3) in place for a number of steps."""
    n = p.shape[0]
    velocity = np.zeros_like(p)
    old = p.copy()
    pairs = np.zeros((40 * n * n, 4), np.int64)
    count = 0
    for number in range(steps):
        for i in range(n):
            for j in range(n):
                velocity[i, j, 2] -= step * gravity
                for axis in range(3):
                    old[i, j, axis] = p[i, j, axis]
                    velocity[i, j, axis] *= 1.0 - drag * step
                    p[i, j, axis] += step * velocity[i, j, axis]
        if number % 12 == 0:
            count = nearby_pairs(p, 2.0 * thickness, pairs)
        project_elastic(p, spacing, shear, bending)
        for c in range(count):
            project_distance(p, pairs[c, 0], pairs[c, 1], pairs[c, 2], pairs[c, 3], thickness, 0.0, False)
        project_contacts(p, old, ball, radius, gap, friction)
        for i in range(n):
            for j in range(n):
                for axis in range(3):
                    velocity[i, j, axis] = (p[i, j, axis] - old[i, j, axis]) / step
