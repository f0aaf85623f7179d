"""Evaluations and samples of the fiber BSDF per second, ours beside Mitsuba's `hair`, in one run.

    python tests/scattering/bench_fiber.py [million directions per call, default 0.5]

Random vertices and directions, so that branches and caches get no help. Ours is measured as a path tracer uses it, each
vertex prepared once; "eval" and "sample" both include the preparation, "eval + sample" shares one. Mitsuba evaluates
value and density (`eval_pdf`) in llvm_ad_rgb, and is timed after its compilation. Both on as many threads as there are
cores, ours on one thread too. The fastest of 25 short calls counts, since machines are shared.
"""

from __future__ import annotations

import math
import os
import sys
import time

import numba
import numpy as np
from numba import njit, prange

from usdfab.scattering.fiber_numba import eval_fiber, load_fiber, pack_fiber, prepare_fiber, sample_fiber

ALBEDO, GAMMA_N, AIR = (0.8, 0.4, 0.2), 0.05, 1.000277


@njit(parallel=True)
def _loop(materials, x, mode):
    """Mode 0: prepare; 1: and evaluate; 2: and sample; 3: all three. x (n, 8): h, sines, phi, four numbers."""
    total = 0.0
    for i in prange(x.shape[0]):
        p = load_fiber(materials, 0)
        value = 0.0
        prep = prepare_fiber(p, x[i, 0], x[i, 1], math.sqrt(1.0 - x[i, 1] ** 2))
        if mode == 0:
            for part in prep:
                value += part
        if mode == 1 or mode == 3:
            r, g, b, pdf = eval_fiber(p, prep, x[i, 2], math.sqrt(1.0 - x[i, 2] ** 2), x[i, 3])
            value += r + g + b + pdf
        if mode >= 2:
            for part in sample_fiber(p, prep, x[i, 4], x[i, 5], x[i, 6], x[i, 7]):
                value += part
        total += value
    return total


def _best(function, repeats=25):
    """Seconds of the fastest of some calls, after one for warming up."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def _ours(n, threads):
    numba.set_num_threads(threads)
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-1, 1, (n, 3)), rng.uniform(-math.pi, math.pi, (n, 1)), rng.random((n, 4))], axis=1)
    for gammas in ((0.5, GAMMA_N, 0.12), (0.4, 0.15, 0.4), (1.0, 1.0, 1.0)):
        p = pack_fiber(ALBEDO, *gammas)[None]
        rates = [n / _best(lambda mode=mode, p=p: _loop(p, x, mode)) / 1e6 for mode in range(4)]
        names = ("prepare", "eval", "sample", "eval + sample")
        text = ", ".join(f"{name} {rate:.1f}" for name, rate in zip(names, rates, strict=True))
        print(f"usdfab, {threads} thread(s), gammas {gammas}: {text} million/s")


def _mitsuba(n):
    try:
        import drjit as dr
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        dr.eval(dr.arange(mi.Float, 4))
    except Exception as error:  # noqa: BLE001 - whatever is missing, the rest of the benchmark has run
        print(f"Mitsuba: not measured ({error})")
        return
    for gamma_m, gamma_n in ((0.5, GAMMA_N), (0.4, 0.15), (1.0, 1.0)):
        sigma = mi.ScalarColor3f([float(v) for v in pack_fiber(ALBEDO, gamma_m, gamma_n, gamma_m)[:3]])
        bsdf = mi.load_dict(
            {
                "type": "hair",
                "sigma_a": {"type": "rgb", "value": list(sigma)},
                "longitudinal_roughness": gamma_m,
                "azimuthal_roughness": gamma_n,
                "scale_tilt": 0.0,
                "int_ior": 1.55,
                "ext_ior": AIR,
            }
        )
        rng = mi.PCG32(size=n)
        pairs = [mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(4)]
        si = dr.zeros(mi.SurfaceInteraction3f, n)
        si.t = 1.0
        si.wi = mi.warp.square_to_uniform_hemisphere(pairs[0])
        si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
        wo = mi.warp.square_to_uniform_sphere(pairs[1])
        dr.eval(si, wo, pairs)
        context = mi.BSDFContext()

        def evaluate(bsdf=bsdf, si=si, wo=wo, context=context):
            value, pdf = bsdf.eval_pdf(context, si, wo)
            dr.eval(dr.sum(dr.sum(value) + pdf))
            dr.sync_thread()

        def sample(bsdf=bsdf, si=si, pairs=pairs, context=context):
            drawn, weight = bsdf.sample(context, si, pairs[2].x, pairs[3])
            dr.eval(dr.sum(dr.sum(weight) + drawn.pdf + drawn.wo.x))
            dr.sync_thread()

        rates = n / _best(evaluate) / 1e6, n / _best(sample) / 1e6
        print(
            f"Mitsuba hair, llvm_ad_rgb, {dr.thread_count()} threads, gammas {(gamma_m, gamma_n)}: "
            f"eval {rates[0]:.1f}, sample {rates[1]:.1f} million/s"
        )


if __name__ == "__main__":
    directions = int(float(sys.argv[1]) * 1e6) if len(sys.argv) > 1 else 500_000
    cores = min(len(os.sched_getaffinity(0)), numba.config.NUMBA_NUM_THREADS)
    _ours(directions, 1)
    if cores > 1:
        _ours(directions, cores)
    _mitsuba(directions)
