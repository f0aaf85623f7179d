"""From analysis to fabric: priors, albedo inversion, physical size, provenance."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters, YarnParameters, weave_from_name
from usdfab.fibers import generate_patch
from usdfab.fit.albedo import (
    BrightnessCurve,
    brightness_curves,
    dimmed,
    photo_exposure,
    visible_means,
    with_inverted_albedo,
    with_inverted_albedo_and_light,
)
from usdfab.fit.analysis import PhotoAnalysis, YarnSystem
from usdfab.fit.pipeline import DEFAULT_WIDTH, fit_photo
from usdfab.fit.priors import assumed_notes, fabric_from_analysis
from usdfab.imaging import write_image
from usdfab.imaging.lens import toned
from usdfab.usd.rig import rig_for

CLOTH = FabricParameters(
    weave_from_name("plain"),
    (3e-3, 3e-3),
    YarnParameters(count=6, radius=2e-4, fiber_count=30, albedo=(0.7, 0.3, 0.2), roughness_azimuthal=0.3),
    YarnParameters(count=6, radius=2e-4, fiber_count=30, albedo=(0.2, 0.5, 0.8), roughness_azimuthal=0.3),
)


FEW = 5_000
"""Paths for albedos where a test is not about them."""

DRAWN = Cloth(weave_from_name("plain").matrix, 8, 8, size=240)


def system(**changes: object) -> YarnSystem:
    values: dict = {
        "count": 10.0,
        "spacing": 40.0,
        "count_confidence": 0.9,
        "width": 0.8,
        "width_confidence": 0.9,
        "colour": np.array([0.4, 0.3, 0.2]),
        "colour_confidence": 0.9,
        "yarn_colours": np.tile([0.4, 0.3, 0.2], (10, 1)),
        "colour_sequence": np.array([[0.4, 0.3, 0.2]]),
        "twist": "Z",
        "fiber_angle": 0.3,
        "twist_confidence": 0.9,
    }
    return YarnSystem(**(values | changes))


def analysis(warp: YarnSystem, weft: YarnSystem, weave: str = "plain") -> PhotoAnalysis:
    matrix = weave_from_name(weave)
    return PhotoAnalysis((400, 400), warp, weft, 0.0, 0.0, 0.9, 0.05, 0.9, matrix, matrix.classify(), 0.9, 0.9, ())


def test_measured_numbers_keep_their_physical_meaning() -> None:
    fabric, _ = fabric_from_analysis(analysis(system(), system(spacing=50.0, width=0.6)), 4e-3)
    assert fabric.size == pytest.approx((4e-3, 4e-3))
    assert fabric.warp.count == pytest.approx(10)
    assert fabric.weft.count == pytest.approx(8)
    assert fabric.cover("warp") == pytest.approx(0.8)
    assert fabric.cover("weft") == pytest.approx(0.6)


@pytest.mark.parametrize("angle", [0.35, -0.2])
def test_twist_prior_reproduces_the_measured_fiber_angle(angle: float) -> None:
    fabric, _ = fabric_from_analysis(analysis(system(fiber_angle=angle), system(fiber_angle=angle)), 4e-3)
    straight = {"crimp": 0.0, "irregularity": 0.0, "migration": 0.0}
    fabric = replace(fabric, warp=replace(fabric.warp, **straight), weft=replace(fabric.weft, **straight))
    warp = generate_patch(fabric).warp
    edges = np.diff(warp.points, axis=0)
    top = (warp.points[:-1, 2] > 0.9 * fabric.warp.radius) & (np.linalg.norm(edges, axis=1) < 1e-4)
    lean = np.arctan(edges[top, 0] / edges[top, 1])  # from upright, positive to the right: Z
    assert np.median(lean) == pytest.approx(angle, abs=0.05)


def test_uncertain_estimates_give_way_to_priors() -> None:
    unsure = system(twist_confidence=0.1, width_confidence=0.1, fiber_angle=0.7, width=0.4)
    seen = analysis(unsure, system())
    fabric, _ = fabric_from_analysis(seen, 4e-3)
    assert fabric.warp.twist == pytest.approx(0.08)
    assert fabric.cover("warp") > 1.0
    notes = assumed_notes(seen, fabric, fabric)
    assert any("twist of the warp" in note for note in notes) and not any("of the weft" in note for note in notes)
    assert "fiber count, crimp" in notes[-1]
    # What a later stage has found is no prior any more.
    found = replace(fabric, warp=replace(fabric.warp, twist=0.2, crimp=0.5))
    assert assumed_notes(seen, fabric, found) == (notes[-1].replace(" crimp,", ""),)


def test_colors_of_ends_are_kept_unless_the_repeat_grows_too_large() -> None:
    three = np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
    fabric, _ = fabric_from_analysis(analysis(system(colour_sequence=three), system()), 4e-3)
    assert fabric.warp.yarn_albedo == pytest.approx(np.array(three))
    long = np.tile(three, (13, 1))[:37]
    fabric, notes = fabric_from_analysis(analysis(system(colour_sequence=long), system(colour_sequence=long)), 4e-3)
    assert any("repeat" in note for note in notes)
    assert math.prod(fabric.repeat()) <= 1600


def test_brightness_curves_rise_and_read_backwards() -> None:
    curve = BrightnessCurve(np.array([0.0, 0.5, 1.0]), np.array([0.0, 0.1, 0.6]))
    assert curve.albedo_of(0.1) == pytest.approx(0.5)
    assert curve.albedo_of(2.0) == pytest.approx(1.0)
    for measured in brightness_curves(CLOTH, paths=20_000).values():
        assert np.all(np.diff(measured.albedo) > 0) and np.all(np.diff(measured.brightness) >= 0)
        assert measured.brightness[-1] > 3 * measured.brightness[2]


def test_albedo_is_found_again_from_the_colors_that_it_shows() -> None:
    seen = visible_means(CLOTH, seed=5)
    shown = replace(
        CLOTH,
        warp=replace(CLOTH.warp, albedo=tuple(np.clip(seen["warp"], 0, 1))),
        weft=replace(CLOTH.weft, albedo=tuple(np.clip(seen["weft"], 0, 1))),
    )
    found, notes = with_inverted_albedo(shown, brightness_curves(CLOTH))
    assert not notes
    assert np.abs(np.subtract(found.warp.albedo, CLOTH.warp.albedo)).max() < 0.15
    assert np.abs(np.subtract(found.weft.albedo, CLOTH.weft.albedo)).max() < 0.15


def test_bright_yarns_among_dark_ones_keep_their_hue() -> None:
    """Dark neighbours swallow light that the curves of evenly dyed cloth count on; a camera that exposes more, too."""
    cloth = replace(
        CLOTH,
        warp=replace(CLOTH.warp, albedo=(0.93, 0.85, 0.7)),
        weft=replace(CLOTH.weft, albedo=(0.02, 0.02, 0.02)),
    )
    seen = {system: 2.0 * mean for system, mean in visible_means(cloth, seed=5).items()}
    shown = replace(
        cloth,
        warp=replace(cloth.warp, albedo=tuple(np.clip(seen["warp"], 0, 1))),
        weft=replace(cloth.weft, albedo=tuple(np.clip(seen["weft"], 0, 1))),
    )
    curves = brightness_curves(shown)
    exposure = photo_exposure(shown, curves)
    found, light, _ = with_inverted_albedo_and_light(dimmed(shown, exposure), curves)
    assert light > 1.1
    red, green, blue = found.warp.albedo
    assert 0.99 > red > green > blue
    again = {system: exposure * light * mean for system, mean in visible_means(found, seed=9).items()}
    np.testing.assert_allclose(again["warp"], shown.warp.albedo, rtol=0.1)


def test_too_bright_a_photo_is_said() -> None:
    bright = replace(CLOTH, warp=replace(CLOTH.warp, albedo=(1.0, 1.0, 1.0)))
    curves = dict.fromkeys(("warp", "weft"), BrightnessCurve(np.array([0.0, 1.0]), np.array([0.0, 0.9])))
    fabric, notes = with_inverted_albedo(bright, curves)  # type: ignore[arg-type]
    assert fabric.warp.albedo == pytest.approx((0.995,) * 3)
    assert any("warp is brighter" in note for note in notes)


def test_light_is_taken_as_stronger_where_white_fibers_are_too_dark() -> None:
    # Brightness is 0.6 times albedo, so fibers of 0.95 give 0.57.
    curves = dict.fromkeys(("warp", "weft"), BrightnessCurve(np.array([0.0, 1.0]), np.array([0.0, 0.6])))
    dark = replace(CLOTH, warp=replace(CLOTH.warp, albedo=(0.5, 0.1, 0.1)))
    dark = replace(dark, weft=replace(CLOTH.weft, albedo=(0.3, 0.3, 0.3)))
    white = replace(dark, weft=replace(CLOTH.weft, albedo=(0.2, 0.2, 0.2), yarn_albedo=((0.9, 0.95, 0.9), (0.1,) * 3)))
    assert photo_exposure(dark, curves) == 1.0  # type: ignore[arg-type]
    exposure = photo_exposure(white, curves)  # type: ignore[arg-type]
    assert exposure == pytest.approx(0.95 / 0.57)
    assert photo_exposure(dimmed(white, exposure), curves) == pytest.approx(1.0)  # type: ignore[arg-type]
    # Deep red: 0.003 asks for less than fibers of 0.03 show, unless the light is weaker; but not under white yarns.
    red = replace(CLOTH.warp, albedo=(0.05, 0.003, 0.01))
    assert photo_exposure(replace(dark, warp=red), curves) == pytest.approx(0.3 / 0.57)  # type: ignore[arg-type]
    assert photo_exposure(replace(dark, warp=red, weft=red), curves) == pytest.approx(math.sqrt(0.003 / 0.018))  # type: ignore[arg-type]
    assert photo_exposure(replace(white, warp=red), curves) == pytest.approx(exposure)  # type: ignore[arg-type]
    assert dimmed(white, 2.0).weft.yarn_albedo[0] == pytest.approx((0.45, 0.475, 0.45))


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photo") / "my cloth-1.png"
    write_image(path, draw(DRAWN))
    return path


def test_size_comes_from_the_option_the_tags_or_the_default(photo: Path, tmp_path: Path) -> None:
    by_size = fit_photo(photo, width=3e-3, albedo_paths=FEW)
    assert by_size.fabric.size[0] == pytest.approx(3e-3)
    assert by_size.fabric.provenance.source_sha256 == hashlib.sha256(photo.read_bytes()).hexdigest()
    assert by_size.fabric.name == "MyCloth1"
    assert fit_photo(photo, pixel_size=1e-5, albedo_paths=FEW).fabric.size[0] == pytest.approx(2.4e-3)
    default = fit_photo(photo, albedo_paths=FEW)
    assert default.fabric.size[0] == pytest.approx(DEFAULT_WIDTH)
    assert any("--size" in warning for warning in default.warnings)
    tagged = tmp_path / "tagged.tif"
    write_image(tagged, draw(DRAWN), pixel_size=(8e-6, 8e-6))
    assert fit_photo(tagged, albedo_paths=FEW).fabric.size[0] == pytest.approx(240 * 8e-6, rel=0.01)


def test_the_contrast_of_a_known_camera_is_taken_out_of_the_photo(tmp_path: Path) -> None:
    """The same light through another camera is the same cloth."""
    light = draw(DRAWN).astype(np.float32)
    rig = replace(rig_for((3e-3, 3e-3)), contrast=1.5)
    fits = []
    for name, pixels, given in (("linear", light, replace(rig, contrast=1.0)), ("toned", toned(light, 1.5), rig)):
        write_image(tmp_path / f"{name}.exr", pixels)
        fits.append(fit_photo(tmp_path / f"{name}.exr", albedo_paths=FEW, rig=given))
    first, second = fits
    np.testing.assert_allclose(second.photo, first.photo, atol=1e-3)
    for system in SYSTEMS:
        one, other = (fit.fabric.system(system) for fit in fits)
        assert other.radius == pytest.approx(one.radius, rel=1e-3)
        seen = [getattr(fit.analysis, system).colour for fit in fits]
        np.testing.assert_allclose(seen[1], seen[0], atol=5e-3)
    assert second.rig == replace(rig, contrast=1.0)
    assert any("contrast of 1.5" in note for note in second.fabric.provenance.notes)
    assert not any("contrast" in note for note in first.fabric.provenance.notes)


def test_contradictions_about_size_are_refused(photo: Path) -> None:
    with pytest.raises(UsdfabError, match="--pixel-size"):
        fit_photo(photo, width=3e-3, pixel_size=1e-5)
    with pytest.raises(UsdfabError, match="plausible"):
        fit_photo(photo, width=1e3)
