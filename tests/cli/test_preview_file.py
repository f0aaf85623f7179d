"""``out.preview.png``: there while kernels are compiled, gone with the render, and never in anybody's way."""

from __future__ import annotations

import pytest
from numba import njit

from usdfab.cli.picture import PictureOptions
from usdfab.cli.preview import Preview
from usdfab.cli.render_files import RenderFile
from usdfab.imaging import read_image
from usdfab.tracer import Tracer
from usdfab.tracer.compilation import announce_compilation
from usdfab.tracer.render import Shot
from usdfab.usd.fabric_io import read_fabric
from usdfab.usd.rig import swatch_scene


@pytest.fixture
def made(tiny, tmp_path):
    scene = swatch_scene(read_fabric(tiny))
    out = tmp_path / "out.exr"
    file = RenderFile(out, out, tmp_path / "out.exr.partial", None, False)
    shot = Shot(scene.cameras[0], 2000, 1000, 0, 8)
    return lambda quiet=False, tracer=True: Preview(
        file, Tracer(scene) if tracer else None, shot, PictureOptions(), quiet=quiet
    )


def test_it_is_there_while_something_is_compiled_and_gone_afterwards(made, tmp_path, capsys):
    @njit
    def double(x):
        return x + x

    path = tmp_path / "out.preview.png"
    with made() as shown, announce_compilation(shown.show):
        assert not path.exists()
        double(1)
        assert read_image(path).pixels.shape[:2] == (320, 640)
    assert list(tmp_path.iterdir()) == []
    said = capsys.readouterr().err
    assert "compiling" in said and "out.preview.png" in said


def test_it_goes_with_an_interrupt(made, tmp_path):
    with pytest.raises(KeyboardInterrupt), made() as shown:
        shown.show("compiling")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_that_name_stays(made, tmp_path, capsys):
    path = tmp_path / "out.preview.png"
    path.write_text("mine")
    with made() as shown:
        shown.show("compiling")
    assert path.read_text() == "mine"
    assert capsys.readouterr().err.strip().endswith("compiling")


def test_without_a_place_to_write_the_render_goes_on(made, tmp_path, capsys):
    with made() as shown:
        shown.path = tmp_path / "no" / "out.preview.png"
        shown.show("compiling")
    assert "no preview" in capsys.readouterr().err


def test_quietly_and_where_others_render(made, tmp_path, capsys):
    with made(quiet=True) as shown:
        shown.show("compiling")
        assert (tmp_path / "out.preview.png").exists()
    with made(tracer=False) as shown:
        shown.show("compiling elsewhere")
        assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.strip().endswith("compiling elsewhere")
