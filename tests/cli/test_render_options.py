"""What people write behind the options of ``usdfab render``, and which files come of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from pxr import Usd

from usdfab.cli.options import frame_path, parse_region, parse_tile
from usdfab.cli.picture import picture_options
from usdfab.cli.render_files import part_path, plan_files
from usdfab.cli.scene_source import frame_numbers
from usdfab.errors import UsdfabError
from usdfab.tracer.aovs import AOVS, parse_aovs


@pytest.mark.parametrize(
    ("text", "pixels"),
    [
        ("0,0,10,20", (0, 0, 10, 20)),
        (" 1, 2,3 ,4", (1, 2, 3, 4)),
        ("25%,25%,75%,100%", (160, 120, 480, 480)),
        ("0,50%,12.5%,480", (0, 240, 80, 480)),
    ],
)
def test_regions(text, pixels):
    region = parse_region(text)
    assert region is not None and region.pixels(640, 480) == pixels
    assert parse_region(None) is None


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,4,5", "a,b,c,d", "1.5,0,3,4", "-1,0,3,4", "1%%,0,2,3", "1 2 3 4"])
def test_what_is_no_region(text):
    with pytest.raises(UsdfabError, match="--region"):
        parse_region(text)


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """A file whose time codes run from 3 to 5."""
    path = tmp_path_factory.mktemp("frames") / "stage.usda"
    made = Usd.Stage.CreateNew(str(path))
    made.SetStartTimeCode(3)
    made.SetEndTimeCode(5)
    made.Save()
    return path


@pytest.mark.parametrize(
    ("text", "frames"),
    [("7", [7]), ("1-10x4", [1, 5, 9]), ("all", [3, 4, 5]), ("1-3, 2-5x3,9", [1, 2, 3, 5, 9]), ("5-4", [5, 4])],
)
def test_frames(stage, text, frames):
    assert frame_numbers(stage, text) == frames


@pytest.mark.parametrize("text", ["", "a", "1-", "1-5x0", "1-5x", "1-9999999", "1,,2"])
def test_what_is_no_frames(stage, text):
    with pytest.raises(UsdfabError, match="--frames"):
        frame_numbers(stage, text)


@pytest.mark.parametrize(
    ("pattern", "frame", "name"),
    [
        ("a/out.exr", 7, "a/out.0007.exr"),
        ("out.####.exr", 12, "out.0012.exr"),
        ("out_##.v1.exr", 123, "out_123.v1.exr"),
        ("out.%04d.exr", 3, "out.0003.exr"),
        ("out.%d.exr", 3, "out.3.exr"),
        ("out.####.exr", -5, "out.-0005.exr"),
        ("out.####.exr", 7.25, "out.0007.25.exr"),
        ("out.####.exr", -0.5, "out.-0000.5.exr"),
        ("out.%03d.exr", 20.0, "out.020.exr"),
    ],
)
def test_frame_names(pattern, frame, name):
    assert frame_path(Path(pattern), frame) == Path(name)


@given(st.lists(st.integers(-(10**5), 10**5), unique=True, max_size=30))
def test_frames_have_names_of_their_own(frames):
    assert len({frame_path(Path("a.#.png"), frame) for frame in frames}) == len(frames)


def test_tiles():
    assert parse_tile("3/16") == (3, 16) and parse_tile(None) is None
    assert part_path(Path("a/b.exr"), (3, 16)) == Path("a/b.exr.03of16.part")
    for text in ("0/3", "4/3", "1", "1/0", "a/b", "1/2/3", "-1/3"):
        with pytest.raises(UsdfabError, match="--tile"):
            parse_tile(text)


def test_aov_names():
    assert parse_aovs(None) == ()
    assert parse_aovs([]) == parse_aovs(["all"]) == parse_aovs(["depth", "all"]) == tuple(AOVS)
    assert parse_aovs(["depth, normal", "uv", "depth"]) == ("depth", "normal", "uv")
    with pytest.raises(UsdfabError, match=r"--aov: there is no 'deep'; choose of depth, normal"):
        parse_aovs(["deep"])


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("a.png", {"aov": []}, "--aov"),
        ("a.exr", {"exposure": 1.0}, "--exposure"),
        ("a.exr", {"view": "standard"}, "--view"),
        ("a.png", {"view": "pretty"}, "--view"),
        ("a.png", {"exposure": float("nan")}, "--exposure"),
    ],
)
def test_pictures_that_cannot_be(name, changes, words):
    options = {"aov": None, "denoise": False, "exposure": None, "view": None, "overwrite": False}
    with pytest.raises(UsdfabError, match=words):
        picture_options(Path(name), **(options | changes))


def test_files_are_looked_at_before_the_work(tmp_path):
    def plan(name="a.exr", part=None, checkpoint=None, resume=False, overwrite=False):
        return plan_files([(tmp_path / name, None)], part, checkpoint, resume, overwrite)[0]

    file = plan()
    assert (file.output, file.partial, file.finished) == (tmp_path / "a.exr", tmp_path / "a.exr.partial", False)
    assert plan(part=(2, 4)).output == tmp_path / "a.exr.2of4.part"
    with pytest.raises(UsdfabError, match="folder does not exist"):
        plan("no/a.exr")
    with pytest.raises(UsdfabError, match="folder does not exist"):
        plan(checkpoint=tmp_path / "no" / "x")
    with pytest.raises(UsdfabError, match="the output itself"):
        plan(checkpoint=tmp_path / "a.exr")
    file.partial.write_text("half")
    with pytest.raises(UsdfabError, match=r"a\.exr\.partial: an unfinished render is there; go on with --resume"):
        plan()
    assert not plan(resume=True).finished
    file.output.write_text("whole")
    with pytest.raises(UsdfabError, match="the file exists"):
        plan(resume=True)
    assert not plan(overwrite=True).finished
    file.partial.unlink()
    assert plan(resume=True).finished
    with pytest.raises(UsdfabError, match="the file exists"):
        plan()
