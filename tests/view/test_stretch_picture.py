"""The picture of the stretch: drawn where there is cloth, redder where it is drawn out."""

from __future__ import annotations

import numpy as np
import pytest

from usdfab.errors import UsdfabError
from usdfab.imaging import read_image
from usdfab.usd.stretch import Surface, SurfaceReport, measure, spread
from usdfab.view.stretch import color_limit, line_step, render, screenshot

pytest.importorskip("pyvista")


def plane(left=1.0, right=1.0, n=8):
    """A square of one metre that stands upright, x right, z up; its halves are stretched along x by two factors."""
    triangles, cloth = [], []
    for i in range(n):
        factor = left if i < n // 2 else right
        for j in range(n):
            a, b, c, d = [np.array([i + di, j + dj]) / n for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1))]
            for corners in ((a, b, c), (a, c, d)):
                triangles.append([(x, 0.0, y) for x, y in corners])
                cloth.append([(x / factor, y) for x, y in corners])
    points, uv = np.array(triangles), np.array(cloth)
    found = measure(points, uv, 1.0)
    nothing = spread(np.array([np.nan]), np.ones(1))
    report = SurfaceReport(
        "/Cloth", "/Fabric", 1.0, len(points), 1.0, 20, 20, nothing, nothing, nothing, nothing, nothing, nothing,
        1.25, 0, 0, 0,
    )  # fmt: skip
    return Surface(points, uv, found, report)


def colored(pixels):
    """(H, W) where the picture is neither white, black nor grey; without the legend's side."""
    rgb = pixels[:, : int(0.88 * pixels.shape[1])].astype(int)
    return (rgb.max(axis=2) - rgb.min(axis=2)) > 25


def test_the_stretched_half_is_redder():
    pixels = render([plane(1.0, 1.3)], limit=1.3, up_axis="Z", resolution=(320, 240))
    assert pixels.shape == (240, 320, 3)
    mask = colored(pixels)
    assert 0.1 < mask.mean() < 0.9
    columns = np.flatnonzero(mask.any(axis=0))
    middle = (columns[0] + columns[-1]) // 2
    green = np.where(mask, pixels[:, : mask.shape[1], 1], 0).astype(float)
    left, right = (green[:, part].sum() / mask[:, part].sum() for part in (slice(0, middle), slice(middle, None)))
    assert left > right + 60


def test_the_colours_end_at_the_limit_or_where_the_area_does():
    assert color_limit([plane(1.0, 1.1)], 1.25) == 1.25
    assert color_limit([plane(1.0, 2.0)], 1.25) == pytest.approx(2.0)
    assert color_limit([plane(1.0, 9.0)], 1.25) == 4.0


def test_lines_lie_at_round_distances():
    assert line_step([plane()]) == pytest.approx(0.05)


def test_files_and_errors(tmp_path):
    path = screenshot(tmp_path / "s.png", [plane()], up_axis="Z", resolution=(160, 120))
    assert np.asarray(read_image(path).pixels).shape[:2] == (120, 160)
    with pytest.raises(UsdfabError, match="no surface"):
        render([])
    with pytest.raises(UsdfabError, match="resolution"):
        render([plane()], resolution=(4, 4))
