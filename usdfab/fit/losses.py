"""The priors of the optimisation stages (Li et al. 2024, eq. 14); :mod:`usdfab.fit.texture` has the other losses."""

from __future__ import annotations

from torch import Tensor

from usdfab.errors import UsdfabError

ROUGHNESS_PRIORS = {"satin": ((0.1, 0.15), (0.02, 0.15))}
"""Mean and standard deviation of gamma_M and of gamma_M0 for weave classes (Li et al. 2024, section 7.2)."""

WIDE_PRIOR = ((0.5, 5.0), (0.5, 5.0))
"""For plain, twill and all else: no effect to speak of."""

LONGITUDINAL, PRIMARY = 0, 2
"""Columns of gamma_M and gamma_M0 in ``usdfab.fabric.optics.ROUGHNESSES``."""


def roughness_prior(weave_class: str, roughness: Tensor) -> Tensor:
    """Minus the logarithm of the Gaussian priors on gamma_M and gamma_M0, 0 where both are at their means (eq. 14).

    Parameters
    ----------
    weave_class:
        plain, twill, satin, basket or other, as ``Weave.weave_class`` and the analysis say.
    roughness:
        (..., 3), columns as ``Optics.roughness``: gamma_M, gamma_N, gamma_M0. Rows are yarn systems; the paper's
        formula has one pair, so rows are averaged.

    Raises
    ------
    UsdfabError
        For roughness that is not finite.
    """
    if roughness.shape[-1:] != (3,) or not roughness.isfinite().all():
        raise UsdfabError("roughness is not finite or not (..., 3)", remedy="give gamma_M, gamma_N, gamma_M0")
    longitudinal, primary = ROUGHNESS_PRIORS.get(weave_class, WIDE_PRIOR)
    exponents = [
        (roughness[..., column] - mean).square() / (2.0 * deviation**2)
        for column, (mean, deviation) in ((LONGITUDINAL, longitudinal), (PRIMARY, primary))
    ]
    return (exponents[0] + exponents[1]).mean()
