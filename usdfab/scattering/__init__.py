"""How a single textile fiber scatters light: the near-field fiber BSDF of Chiang et al. (2015).

`roughness` holds the plain NumPy maps from perceptual parameters to those of the lobes, `fiber_numba` the BSDF itself
as Numba functions of scalars. This file imports neither: Numba is loaded by those who shade.
"""
