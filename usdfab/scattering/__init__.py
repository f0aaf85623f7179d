"""How a single textile fiber scatters light: the near-field fiber BSDF of Chiang et al. (2015).

`roughness` holds the plain NumPy maps from perceptual parameters to those of the lobes; the BSDF itself is written once
for each target, side by side and held together by tests: `fiber_numba` as Numba functions of scalars, `fiber_drjit` for
arrays of Dr.Jit, which differentiates them, `fiber_torch` for torch. `fiber_numba_grad` has the derivatives of the
first by the material, by hand; `fiber_numba_wide` is what a wide pixel sees of it, with derivatives by all. This file
imports none: Numba, Dr.Jit and torch are loaded by those who shade.
"""
