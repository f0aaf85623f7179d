"""Colours per end and per pick, from the draft to the picture: right yarns, right order, right side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from usdfab.fabric import FabricParameters, YarnParameters, read_wif, with_draft
from usdfab.fabric.draft_picture import crossing_colors
from usdfab.fibers import generate_patch
from usdfab.tracer import RenderSettings, Tracer
from usdfab.usd.fabric_io import read_fabric, write_fabric
from usdfab.usd.rig import swatch_scene

# A twill on four shafts in six warp and five weft colours: no symmetry, neither turned nor mirrored.
ENDS = ("#ff0000", "#00ff00", "#0000ff", "#ffff00", "#ff00ff", "#00ffff")
PICKS = ("#800000", "#008000", "#000080", "#808000", "#808080")


def draft_text() -> str:
    colors = [*ENDS, *PICKS]
    rows = [[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in colors]
    table = "\n".join(f"{k}={r},{g},{b}" for k, (r, g, b) in enumerate(rows, start=1))
    ends, picks = range(1, 13), range(1, 21)
    return "\n".join(
        [
            "[WEAVING]\nShafts=4\nTreadles=4\nRising Shed=1",
            "[WARP]\nThreads=12\nUnits=Centimeters\nSpacing=0.05\nThickness=0.048",
            "[WEFT]\nThreads=20\nUnits=Centimeters\nSpacing=0.05\nThickness=0.048",
            f"[COLOR PALETTE]\nEntries=11\nRange=0,255\n[COLOR TABLE]\n{table}",
            "[THREADING]\n" + "\n".join(f"{k}={(k - 1) % 4 + 1}" for k in ends),
            "[TIEUP]\n1=1,2\n2=2,3\n3=3,4\n4=4,1",
            "[TREADLING]\n" + "\n".join(f"{k}={(k - 1) % 4 + 1}" for k in picks),
            "[WARP COLORS]\n" + "\n".join(f"{k}={(k - 1) % 6 + 1}" for k in ends),
            "[WEFT COLORS]\n" + "\n".join(f"{k}={(k - 1) % 5 + 7}" for k in picks),
        ]
    )


@pytest.fixture
def striped(tmp_path: Path) -> FabricParameters:
    """The draft as a fabric of regular yarns, through a USD file."""
    path = tmp_path / "draft.wif"
    path.write_text(draft_text())
    yarn = YarnParameters(
        count=10, radius=2e-4, fiber_count=10, irregularity=0.0, inclination=0.5, packing=0.8, twist=0.05
    )
    base = FabricParameters(size=(5e-3, 5e-3), warp=yarn, weft=yarn, variants=1)
    return read_fabric(write_fabric(with_draft(base, read_wif(path)), tmp_path / "f.usda"))


def test_each_curve_of_the_patch_has_its_yarns_colour(striped: FabricParameters) -> None:
    assert striped.repeat() == (20, 12)
    patch = generate_patch(striped, 8)
    for system, count, axis in ((patch.warp, 12, 0), (patch.weft, 20, 1)):
        own = np.asarray(striped.system(system.system).colors())
        assert len(own) == (6 if axis == 0 else 5)
        middle = np.add.reduceat(system.points[:, axis], system.offsets[:-1]) / np.diff(system.offsets)
        # Ends are counted from the left, picks from below.
        assert np.array_equal(np.round(middle / 5e-4 - 0.5), system.yarn)
        assert set(system.yarn.tolist()) == set(range(count))
        np.testing.assert_array_equal(system.albedo, own[system.yarn % len(own)])


def test_the_picture_shows_the_drawdown(striped: FabricParameters) -> None:
    """The albedo seen in the middle of each crossing is the colour of the yarn on top there."""
    expected = crossing_colors(striped)  # (20, 12, 3), pick 1 first
    size = striped.size
    copies = round(size[0] / 6e-3), round(size[1] / 1e-2)
    expected = np.tile(expected, (copies[1], copies[0], 1))
    pixels = 6
    scene = swatch_scene(striped)
    resolution = (pixels * expected.shape[1], pixels * expected.shape[0])
    render = Tracer(scene).render(scene.cameras[0], RenderSettings(resolution, spp=4, max_depth=1))
    assert render.albedo.shape == (resolution[1], resolution[0], 3)
    # The camera's height holds the sample; pixel rows run from the top.
    tan_half, camera = scene.cameras[0].tan_half, scene.cameras[0].to_world
    distance = camera[2, 3]
    per_meter = np.array(resolution) / (2 * distance * np.asarray(tan_half))
    palette = np.concatenate([striped.warp.colors(), striped.weft.colors()])
    seen = np.empty_like(expected)
    for i, j in np.ndindex(expected.shape[:2]):
        x, y = (j + 0.5) * 5e-4 - size[0] / 2, (i + 0.5) * 5e-4 - size[1] / 2
        column = int(resolution[0] / 2 + (x - camera[0, 3]) * per_meter[0])
        row = int(resolution[1] / 2 - (y - camera[1, 3]) * per_meter[1])
        window = render.albedo[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].reshape(-1, 3)
        seen[i, j] = palette[np.argmin(np.linalg.norm(palette - np.median(window, axis=0), axis=1))]

    def agreement(drawdown: np.ndarray) -> float:
        return float((seen == drawdown).all(axis=-1).mean())

    # A neighbour's fibers may cover a middle here and there.
    assert agreement(expected) > 0.95
    # Turned, mirrored, or seen from the back it would not do.
    back = np.where(
        np.tile(striped.weave.matrix, (expected.shape[0] // 4, expected.shape[1] // 4))[..., None] == 0,
        palette[6:][np.arange(len(expected)) % 5][:, None],
        palette[:6][np.arange(expected.shape[1]) % 6][None],
    )
    for wrong in (expected[:, ::-1], expected[::-1], expected[::-1, ::-1], back):
        assert agreement(wrong) < 0.4
