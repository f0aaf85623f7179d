"""The table over labelled photos; the goals hold on the real ones where they are at hand."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import plain
from usdfab.fit.analysis import analyze_photo
from usdfab.fit.evaluation import Row, evaluate_photos, format_rows, main, read_photo, totals

PHOTOS = Path(os.environ.get("USDFAB_PHOTOS") or "/nonexistent")
photos = [
    pytest.mark.photos,
    pytest.mark.skipif(not (PHOTOS / "SOURCES.csv").is_file(), reason="USDFAB_PHOTOS is not set"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one drawn cloth and one noise picture."""
    import OpenImageIO as oiio

    path = tmp_path_factory.mktemp("photos")
    pictures = {
        "cloth.png": draw(Cloth(plain().matrix, 10, 12, size=240)),
        "noise.png": np.random.default_rng(0).random((240, 240, 3)),
    }
    for name, linear in pictures.items():
        coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        buffer = oiio.ImageBuf(oiio.ImageSpec(240, 240, 3, oiio.UINT8))
        buffer.set_pixels(oiio.ROI(), np.ascontiguousarray(coded, dtype=np.float32))
        assert buffer.write(str(path / name))
    (path / "SOURCES.csv").write_text(
        "file,weave,notes\n"
        'cloth.png,plain,"drawn; about 10 yarns across horizontally and 12 vertically"\n'
        "noise.png,satin,no counts\n"
    )
    return path


def test_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = evaluate_photos(folder)
    assert [row.file for row in rows] == ["cloth.png", "noise.png"]
    assert rows[0].class_right and rows[1].analysis is None and "no woven lattice" in rows[1].problem
    assert totals(rows) == (1, 2, 2)
    text = format_rows(rows)
    assert "classes right: 1 of 2; counts within 10 %: 2 of 2" in text and "refused" in text
    assert main([str(folder / "missing")]) == 2
    assert main([]) == 2
    assert "usage" in capsys.readouterr().err


def test_missing_table(tmp_path: Path) -> None:
    with pytest.raises(UsdfabError, match="no such file"):
        evaluate_photos(tmp_path)


@pytest.fixture(scope="module")
def photo_rows() -> list[Row]:
    return evaluate_photos(PHOTOS)


class TestPhotos:
    """Real microscope photos."""

    pytestmark = photos

    def test_goals(self, photo_rows: list[Row]) -> None:
        classes, counts, labelled = totals(photo_rows)
        print(format_rows(photo_rows))
        assert labelled == 30
        assert classes >= 11
        assert counts >= 20

    def test_all_are_cloth(self, photo_rows: list[Row]) -> None:
        assert all(row.analysis is not None and row.analysis.lattice_confidence > 0.5 for row in photo_rows)

    def test_time(self, photo_rows: list[Row]) -> None:
        assert np.median([row.seconds for row in photo_rows]) < 10

    @pytest.mark.slow
    def test_flips_and_quarter_turn(self, photo_rows: list[Row]) -> None:
        """Mirrored and turned photos give the mirrored and turned answer wherever the upright answer was confident."""
        asked = same = 0
        for row in photo_rows:
            a = row.analysis
            assert a is not None
            if min(a.warp.count_confidence, a.weft.count_confidence, a.weave_confidence) < 0.6:
                continue
            photo = read_photo(PHOTOS / row.file)
            cases = (
                (photo[:, ::-1], a.warp_count, a.weft_count),
                (photo[::-1], a.warp_count, a.weft_count),
                (np.rot90(photo), a.weft_count, a.warp_count),
            )
            for turned, warp, weft in cases:
                b = analyze_photo(turned)
                asked += 1
                counts = abs(b.warp_count / warp - 1) < 0.05 and abs(b.weft_count / weft - 1) < 0.05
                same += counts and b.weave_class == a.weave_class
        assert asked >= 15
        assert same >= 0.9 * asked
