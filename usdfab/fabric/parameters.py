"""The parameter table: every number that describes a yarn system, declared once.

The schema file, validation, ``usdfab edit --set``, the samplers and the reports all come from ``YARN_PARAMETERS``.
Symbols and equations are those of Li et al. 2024; departures are noted in the doc string of the parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from usdfab.fabric.distributions import Clamped, Distribution, Normal, Uniform

Kind = Literal["float", "int", "color", "colors"]
PerWeave = dict[str, tuple[Distribution, Distribution]]
"""Table 4 of Li et al. 2024: sampling distribution (weft, warp) for ``plain``, ``twill0``, ``twill1``, ``satin``."""


@dataclass(frozen=True)
class Parameter:
    """One row of the table.

    ``hard`` is the closed range outside which a value is refused; ``soft`` is where real fabrics lie and what sliders,
    priors and the unconstrained maps of the fit use. ``stages`` names the stages of ``usdfab fit`` that estimate it.
    ``since`` is the version of the USD schema that brought it.
    """

    name: str
    symbol: str
    unit: str
    kind: Kind
    default: float | int | tuple
    hard: tuple[float, float]
    soft: tuple[float, float]
    doc: str
    stages: tuple[str, ...] = ()
    group: str = "Geometry"
    paper: PerWeave | None = None
    since: int = 1


def _both(plain: Distribution, twill0: Distribution, twill1: Distribution, satin: Distribution) -> PerWeave:
    return {"plain": (plain,) * 2, "twill0": (twill0,) * 2, "twill1": (twill1,) * 2, "satin": (satin,) * 2}


def _all(distribution: Distribution, satin: Distribution | None = None) -> PerWeave:
    return _both(distribution, distribution, distribution, satin or distribution)


_MIGRATION_RATE = Clamped(Normal(0.2, 0.03), low=0.01)

YARN_PARAMETERS: tuple[Parameter, ...] = (
    Parameter(
        "count", "n", "1", "float", 10.0, (0.5, 1e5), (2.0, 60.0),
        "Number of yarns of this system across the sample (ends for the warp, picks for the weft). The spacing is the "
        "sample size divided by it; it need not be whole.",
        ("analysis", "network"),
        paper={
            "plain": (Uniform(6, 10), Uniform(5, 7)),
            "twill0": (Uniform(9, 11), Uniform(6, 11)),
            "twill1": (Uniform(11, 13), Uniform(9, 11)),
            "satin": (Uniform(11, 13), Uniform(9, 11)),
        },
    ),
    Parameter(
        "radius", "e_yarn", "m", "float", 1.6e-4, (1e-7, 1e-1), (2e-5, 2e-3),
        "Yarn radius, half the height of its cross-section, in metres whatever the stage's units "
        "(Li et al. 2024, eq. 7; there relative to the side of the sample).",
        ("analysis", "network"),
        paper={
            "plain": (Uniform(0.0525, 0.09625), Uniform(0.0525, 0.09625)),
            "twill0": (Uniform(0.0475, 0.108), Uniform(0.0475, 0.0672)),
            "twill1": (Uniform(0.038, 0.055), Uniform(0.045, 0.0672)),
            "satin": (Uniform(0.0053, 0.0143), Uniform(0.0234, 0.0357)),
        },
    ),
    Parameter(
        "flattening", "f", "1", "float", 1.0, (0.25, 12.0), (1.0, 4.0),
        "Width divided by height of the yarn's cross-section; 1 is round. Real satin is closed because its yarns are "
        "flattened.",
        ("analysis",),
    ),
    Parameter(
        "fiber_count", "m", "1", "int", 200, (1, 20000), (20, 400),
        "Number of fibers in a yarn (Li et al. 2024, eq. 7).",
        ("network",),
        paper=_all(Normal(200, 5)),
    ),
    Parameter(
        "fiber_radius", "r_fiber", "m", "float", 0.0, (0.0, 1e-2), (2e-6, 5e-5),
        "Radius of a fiber in metres. 0 derives it from the packing, radius * sqrt(flattening packing / fiber_count).",
    ),
    Parameter(
        "packing", "packing", "1", "float", 0.35, (0.01, 1.0), (0.2, 0.7),
        "Fraction of the yarn's cross-section (of its plies' where it has several) that is filled by fibers; used only "
        "where fiber_radius is 0.",
    ),
    Parameter(
        "inclination", "u_max", "rad", "float", 0.6, (0.01, 1.57), (0.1, 1.5),
        "Inclination of the centre line at the ends of a segment (Li et al. 2024, eq. 5).",
        ("network", "raster"),
        paper=_all(Uniform(0.1, 1.5)),
    ),
    Parameter(
        "crimp", "beta", "1", "float", 0.9, (0.0, 5.0), (0.1, 1.5),
        "Height of the centre line in yarn radii; 1 means that two crossing yarns of equal size just touch "
        "(Li et al. 2024, eq. 6).",
        ("network", "raster"),
        paper=_all(Uniform(0.3, 1.5)) | {"satin": (Uniform(0.5, 1.5), Uniform(0.1, 0.5))},
    ),
    Parameter(
        "twist", "alpha", "turns/cell", "float", 0.05, (-4.0, 4.0), (-0.3, 0.3),
        "Turns of the fibers about the yarn for each crossing passed; positive is Z twist, negative is S twist. Where "
        "ply_count is above 1: turns of the plies about the yarn, rounded to what lets the plies close over the patch.",
        ("analysis", "network", "raster"),
        paper=_all(Normal(0, 0.03), Normal(0, 0.01)),
    ),
    Parameter(
        "ply_count", "n_ply", "1", "int", 1, (1, 4), (1, 4),
        "Number of plies that the yarn is twisted from, each a bundle of fibers of its own; 1 is a single yarn. The "
        "plies' circles touch each other and the yarn's circle from inside; all hold equally many fibers, fiber_count "
        "being rounded up.",
        since=2,
    ),
    Parameter(
        "ply_twist", "alpha_ply", "turns/cell", "float", -0.05, (-4.0, 4.0), (-0.6, 0.6),
        "Turns of the fibers about their ply's axis for each crossing passed, in a frame that does not turn with the "
        "ply; positive is Z twist. Used only where ply_count is above 1. Plies are usually twisted against their "
        "fibers: -twist lays the fibers on the outside of a two-ply yarn along the yarn.",
        since=2,
    ),
    Parameter(
        "irregularity", "Q", "1", "float", 0.15, (0.0, 1.0), (0.0, 0.6),
        "Noise level of the fibers: amplitude of the vertical noise in yarn radii, and strength of the shift of the "
        "highest point (Li et al. 2024, eq. 9).",
        ("raster",),
    ),
    Parameter(
        "unevenness", "CV", "1", "float", 0.0, (0.0, 0.6), (0.0, 0.3),
        "Standard deviation of the yarn's thickness along it, over its mean; over about a cell. Spun yarns have 0.1 to "
        "0.2, filament yarns next to none.",
        ("match",),
        since=3,
    ),
    Parameter(
        "waviness", "w_yarn", "1", "float", 0.0, (0.0, 2.0), (0.0, 0.5),
        "Standard deviation of the yarn's sideways place about a straight line, in half widths of the yarn (radius "
        "times flattening); over about a cell.",
        ("match",),
        since=3,
    ),
    Parameter(
        "migration", "G", "1", "float", 0.75, (0.0, 1.0), (0.66, 0.84),
        "How far fibers wander between the yarn's axis and its surface (Li et al. 2024, eq. 7).",
        ("network",),
        paper=_all(Normal(0.75, 0.03)),
    ),
    Parameter(
        "migration_rate", "s", "1", "float", 0.2, (0.0, 20.0), (0.01, 0.4),
        "Wanderings of a fiber for each turn of twist (Li et al. 2024, eq. 7).",
        ("network",),
        paper=_all(_MIGRATION_RATE, Clamped(Normal(0.2, 0.03), low=0.01, scale=0.8)),
    ),
    Parameter(
        "flyaway_density", "rho_fly", "1/m", "float", 0.0, (0.0, 1e6), (0.0, 2e4),
        "Flyaways (fibers that stand off the yarn, Zhao et al. 2016) for each metre of yarn.",
        since=2,
    ),
    Parameter(
        "flyaway_loop_fraction", "p_loop", "1", "float", 0.3, (0.0, 1.0), (0.0, 1.0),
        "Share of the flyaways that are loops, which leave the yarn and return; the others are hairs with a free end.",
        since=2,
    ),
    Parameter(
        "flyaway_length", "l_fly", "m", "float", 4e-4, (1e-6, 2e-2), (5e-5, 3e-3),
        "Mean length of a flyaway outside the yarn, measured along it, in metres.",
        since=2,
    ),
    Parameter(
        "flyaway_spread", "s_fly", "1", "float", 0.5, (0.0, 1.0), (0.1, 0.9),
        "How far flyaways stand off: 0 lies along the yarn, 1 stands upright (mean angle over a right angle).",
        since=2,
    ),
    Parameter(
        "albedo", "C", "1", "color", (0.6, 0.6, 0.6), (0.0, 1.0), (0.0, 1.0),
        "Fiber albedo coefficient in linear Rec. 709; sets the absorption inside the fiber (Chiang et al. 2015).",
        ("analysis", "network", "raster", "path"),
        group="Appearance",
        paper=_all(Uniform(0, 1)),
    ),
    Parameter(
        "yarn_albedo", "C_k", "1", "colors", (), (0.0, 1.0), (0.0, 1.0),
        "Albedo of each end or pick of a yarn-dyed cloth, repeated in order; empty where all yarns have `albedo`.",
        ("analysis",),
        group="Appearance",
    ),
    Parameter(
        "albedo_variation", "sigma_C", "1", "float", 0.0, (0.0, 3.0), (0.0, 1.0),
        "How much fibers of a yarn differ in albedo: C^exp(albedo_variation z), z of standard deviation 1, so that the "
        "root of a fiber's absorption (eq. 3) is log-normal. Dyed yarns have about 0.1 to 0.3, melange yarns 0.5 and "
        "more.",
        ("match",),
        group="Appearance",
        since=4,
    ),
    Parameter(
        "roughness_longitudinal", "gamma_M", "1", "float", 0.5, (0.01, 1.0), (0.1, 0.9),
        "Longitudinal roughness of the lobes that pass through the fiber (TT, TRT, rest).",
        ("network", "raster", "path"),
        group="Appearance",
        paper=_all(Clamped(Normal(0.5, 0.1), low=0.01), Clamped(Normal(0.4, 0.1), low=0.01)),
    ),
    Parameter(
        "roughness_azimuthal", "gamma_N", "1", "float", 0.1, (0.01, 1.0), (0.01, 0.3),
        "Azimuthal roughness.",
        ("network", "raster", "path"),
        group="Appearance",
        paper=_both(
            Clamped(Normal(0.05, 0.01), low=0.01),
            Clamped(Normal(0.05, 0.01), low=0.01),
            Clamped(Normal(0.15, 0.01), low=0.01),
            Clamped(Normal(0.05, 0.01), low=0.01),
        ),
    ),
    Parameter(
        "roughness_primary", "gamma_M0", "1", "float", 0.12, (0.01, 1.0), (0.05, 0.5),
        "Primary reflection roughness: longitudinal roughness of the R lobe.",
        ("network", "raster", "path"),
        group="Appearance",
        paper=_all(Uniform(0.1, 0.15)),
    ),
    Parameter(
        "ior", "eta", "1", "float", 1.55, (1.01, 3.0), (1.3, 1.8),
        "Index of refraction of the fiber; 1.55 for cellulose and most textile fibers.",
        group="Appearance",
    ),
    Parameter(
        "cuticle_tilt", "alpha_c", "rad", "float", 0.0, (-0.39, 0.39), (0.0, 0.07),
        "Tilt of the fiber's scales; 0 for most textile fibers, 0.05 for wool.",
        group="Appearance",
    ),
)  # fmt: skip

PARAMETER_BY_NAME: dict[str, Parameter] = {p.name: p for p in YARN_PARAMETERS}
