"""From perceptual fiber parameters to those of the scattering lobes, and back.

Notation, that of Li et al. 2024 (eq. 1 to 3):
    gamma_M   longitudinal roughness, along the fiber, [0.01, 1]
    gamma_M0  primary reflection roughness: gamma_M of the R lobe alone, [0.01, 1]
    gamma_N   azimuthal roughness, across the fiber, [0.01, 1]
    C         albedo of the fiber's inside, (0, 1], per colour channel
    v         variance of the longitudinal function M_p, rad^2
    s         scale of the logistic distribution in the azimuthal function N_p, rad
    sigma_a   absorption coefficient, per unit of fiber radius

The functions take and return scalars or NumPy arrays of any shape (element by element) and check nothing:
`usdfab.scattering.fiber_numba.pack_fiber` does. The fits are polynomials that mean nothing outside their range.

References: Chiang, Bitterli, Tappan, Burley, "A Practical and Controllable Hair and Fur Model for Production Path
Tracing", 2015 (all three fits); d'Eon, Francois, Hill, Letteri, Aubry, "An Energy-Conserving Hair
Reflectance Model", 2011 (what v is); Li et al. 2024, eq. 1 to 3 (the same maps for yarn, and gamma_M0).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = [
    "absorption_from_albedo",
    "albedo_from_absorption",
    "azimuthal_scale",
    "lobe_variances",
    "longitudinal_variance",
]


def longitudinal_variance(gamma_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Variance v of the longitudinal function from a longitudinal roughness.

    v = (0.726 g + 0.812 g^2 + 3.7 g^20)^2, Chiang et al. 2015.

    Parameters
    ----------
    gamma_m: (...) float
        Longitudinal roughness. Range: [0.01, 1].

    Returns
    -------
    (...) float64
        Variance, rad^2, from 5.4e-5 to 27.4 over the range.

    Example
    -------
    >>> round(float(longitudinal_variance(0.5)), 4)
    0.3204
    """
    g = np.asarray(gamma_m, dtype=np.float64)
    return (0.726 * g + 0.812 * g**2 + 3.7 * g**20) ** 2


def lobe_variances(gamma_m: npt.ArrayLike, gamma_m0: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Variances of the four lobes R, TT, TRT and the rest.

    v(gamma_M0), v/4, 4v, 4v with v = v(gamma_M): d'Eon et al. 2011 for the factors, Li et al. 2024 for the separate
    roughness of R. With gamma_M0 = gamma_M this is the model of Chiang et al. 2015.

    Parameters
    ----------
    gamma_m, gamma_m0: (...) float
        Longitudinal and primary reflection roughness, of one shape. Range: [0.01, 1].

    Returns
    -------
    (..., 4) float64
        Variances, rad^2.
    """
    v = longitudinal_variance(gamma_m)
    return np.stack([longitudinal_variance(gamma_m0), 0.25 * v, 4.0 * v, 4.0 * v], axis=-1)


def azimuthal_scale(gamma_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Scale s of the logistic distribution from an azimuthal roughness.

    s = sqrt(pi / 8) (0.265 g + 1.194 g^2 + 5.372 g^22), Chiang et al. 2015.

    Parameters
    ----------
    gamma_n: (...) float
        Azimuthal roughness. Range: [0.01, 1].

    Returns
    -------
    (...) float64
        Scale, rad, from 0.0017 to 4.28 over the range.

    Example
    -------
    >>> round(float(azimuthal_scale(0.05)), 5)
    0.01017
    """
    g = np.asarray(gamma_n, dtype=np.float64)
    return np.sqrt(np.pi / 8.0) * (0.265 * g + 1.194 * g**2 + 5.372 * g**22)


def absorption_from_albedo(albedo: npt.ArrayLike, gamma_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Absorption sigma_a from the albedo coefficient C.

    sigma_a = (ln C / q(gamma_N))^2, Chiang et al. 2015. C is roughly the colour that a thick assembly of such
    fibers shows after multiple scattering; it is not the albedo of one fiber. C = 1 gives 0 exactly.

    Parameters
    ----------
    albedo: (...) float
        Albedo coefficient C. Range: (0, 1].
    gamma_n: (...) float
        Azimuthal roughness, of a shape that broadcasts with `albedo`. Range: [0.01, 1].

    Returns
    -------
    (...) float64
        Absorption coefficient, per unit of fiber radius. Range: [0, inf).

    Example
    -------
    >>> absorption_from_albedo([1.0, 0.5], 0.3).round(5).tolist()
    [0.0, 0.01386]
    """
    return (np.log(np.asarray(albedo, dtype=np.float64)) / _albedo_polynomial(gamma_n)) ** 2


def albedo_from_absorption(sigma_a: npt.ArrayLike, gamma_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Albedo coefficient C from absorption: the inverse of `absorption_from_albedo`, in the same units.

    C = exp(-q(gamma_N) sqrt(sigma_a)); the root is taken so that C <= 1.

    Parameters
    ----------
    sigma_a: (...) float
        Absorption coefficient, per unit of fiber radius. Range: [0, inf).
    gamma_n: (...) float
        Azimuthal roughness, of a shape that broadcasts with `sigma_a`. Range: [0.01, 1].

    Returns
    -------
    (...) float64
        Albedo coefficient C. Range: (0, 1].
    """
    return np.exp(-_albedo_polynomial(gamma_n) * np.sqrt(np.asarray(sigma_a, dtype=np.float64)))


def _albedo_polynomial(gamma_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The fit q(gamma_N) between ln C and sqrt(sigma_a), Chiang et al. 2015: 3.37 to 5.98 over the range."""
    g = np.asarray(gamma_n, dtype=np.float64)
    return 5.969 - 0.215 * g + 2.532 * g**2 - 10.73 * g**3 + 5.574 * g**4 + 0.245 * g**5
