"""WIF files: what real programs write, round trips, and files that no program should ever have written."""

from __future__ import annotations

import random
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from usdfab.errors import UsdfabError
from usdfab.fabric import (
    NAMED_WEAVES,
    Draft,
    FabricParameters,
    Weave,
    YarnParameters,
    preset,
    read_wif,
    weave_from_name,
    with_draft,
    write_wif,
)
from usdfab.fabric.ini import decode, parse_ini
from usdfab.fabric.wif import MAX_THREADS
from usdfab.fabric.wif_write import MAX_TREADLES, wif_text
from usdfab.srgb import srgb_to_linear

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "shepherd-check.wif"

TWILL = """
[WIF]
Version=1.1
[WEAVING]
Shafts=4
Treadles=4
Rising Shed=1
[WARP]
Threads=8
Color=1
Units=Centimeters
Spacing=0.1
[WEFT]
Threads=8
Color=2
Units=Centimeters
Spacing=0.2
[COLOR PALETTE]
Entries=2
Range=0,255
[COLOR TABLE]
1=255,0,0
2=0,0,255
[THREADING]
1=1
2=2
3=3
4=4
5=1
6=2
7=3
8=4
[TIEUP]
1=1,2
2=2,3
3=3,4
4=4,1
[TREADLING]
1=1
2=2
3=3
4=4
5=1
6=2
7=3
8=4
"""

LIFTS = "1=1,2\n2=2,3\n3=3,4\n4=1,4\n5=1,2\n6=2,3\n7=3,4\n8=1,4\n"


def read(folder: Path, text: str | bytes, name: str = "draft.wif") -> Draft:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_wif(path)


def without(text: str, *sections: str) -> str:
    blocks = ("\n" + text.strip()).split("\n[")
    return "\n[".join(b for b in blocks if b.split("]")[0] not in sections)


# --- reading ---------------------------------------------------------------------------------------------------------


def test_a_plain_twill(tmp_path: Path) -> None:
    draft = read(tmp_path, TWILL)
    assert draft.weave.rows() == "0011/1001/1100/0110" and draft.warnings == ()
    assert draft.warp.colors == ((1, 0, 0),) * 4 and draft.weft.colors == ((0, 0, 1),) * 4
    assert (draft.warp.spacing, draft.weft.spacing) == pytest.approx((1e-3, 2e-3))
    assert draft.warp.thickness == 0 and draft.name == "draft"


def test_the_sample() -> None:
    draft = read_wif(SAMPLE)
    assert draft.name == "Shepherd's check" and draft.warnings == ()
    light, dark = (tuple(srgb_to_linear(np.array(c) / 255)) for c in ((226, 214, 190), (58, 44, 38)))
    for yarns in (draft.warp, draft.weft):
        np.testing.assert_allclose(yarns.colors, [light] * 4 + [dark] * 4)
        assert (yarns.spacing, yarns.thickness) == pytest.approx((0.05 * 0.0254, 0.045 * 0.0254))
    assert draft.weave.classify() == "twill"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.replace("\n", "\r\n"), ""),
        (lambda t: t.replace("\n", "\r"), ""),
        (lambda t: "\ufeff" + t, ""),
        (lambda t: t.upper(), ""),
        (lambda t: t.lower(), ""),
        (lambda t: t.replace("=", " = ").replace("[", "  ["), ""),
        (lambda t: t.replace("3=3\n", "3=3 ; the third\n").replace("[WARP]", "; a comment\n[WARP] ; another"), ""),
        (lambda t: t.replace("Rising Shed=1", "Rising Shed=yes"), ""),
        (lambda t: t.replace("Rising Shed=1", ""), "a rising shed is assumed"),
        (lambda t: t.replace("255,0,0", "999,0,0").replace("0,0,255", "0,0,999").replace("0,255", "0,999"), ""),
        (lambda t: t.replace("255,0,0", "5,-5,-5").replace("0,0,255", "-5,-5,5").replace("0,255", "-5,5"), ""),
        (lambda t: t.replace("Range=0,255", ""), "0 to 255 is assumed"),
        (lambda t: t.replace("Color=1", "Color=1,255,0,0"), ""),
        (lambda t: t + "[PRIVATE XYZ STUFF]\n1=2\nTHREADING\n", "XYZ STUFF"),
        (lambda t: t + "[TRANSLATIONS]\na=b\n", "sections that were ignored: TRANSLATIONS"),
        (lambda t: t + "just some words\n", "1 lines are neither"),
        (lambda t: t.replace("1=1\n2=2", "1=1\n1=4\n2=2"), "2 keys come more than once"),
        (lambda t: t.replace("[THREADING]", "[THREADING]\n9=2\n0=1"), "2 lines belong to none of the 8 ends"),
        (lambda t: t.replace("Shafts=4", "Shafts=3"), "shaft 4 of 3"),
        (lambda t: t.replace("Shafts=4\n", ""), "Shafts is missing"),
        (lambda t: t.replace("Threads=8\n", ""), "Threads is missing"),
        (lambda t: t.replace("Treadles=4", "Treadles=40"), ""),
        (lambda t: t + "[LIFTPLAN]\n" + LIFTS, ""),
        (lambda t: t + "[LIFTPLAN]\n1=1\n", "lift plan differs"),
        (lambda t: without(t, "TREADLING") + "\n[LIFTPLAN]\n" + LIFTS, ""),
        (lambda t: t.replace("Threads=8", "Threads=10"), "2 ends are on no shaft"),
        (lambda t: t.replace("[WARP]\nThreads=8", "[WARP]\nThreads=9").replace("8=4\n[TIEUP]", "8=0\n9=4\n[TIEUP]"),
         "1 ends are on no shaft"),
        (lambda t: t.replace("[WEFT]\nThreads=8", "[WEFT]\nThreads=9") + "9=0\n", "1 picks lift no shaft"),
        (lambda t: t.replace("1=255,0,0", "1=255,0,0\n7=0,255,0"), ""),
        (lambda t: t.replace("255,0,0", "300,0,-4"), "outside the range"),
        # Private sections and comments hold whatever they like, also in the middle.
        (lambda t: t.replace("[WARP]", "[PRIVATE A B]\nThreads=99\nColor=x\n\n[WARP]"), "A B"),
    ],
)  # fmt: skip
def test_what_programs_write(tmp_path: Path, change, told: str) -> None:
    draft = read(tmp_path, change(TWILL))
    assert draft.weave.rows() == "0011/1001/1100/0110"
    assert set(draft.warp.colors) == {(1, 0, 0)} and set(draft.weft.colors) == {(0, 0, 1)}
    assert (draft.warp.spacing, draft.weft.spacing) == pytest.approx((1e-3, 2e-3))
    said = " | ".join(draft.warnings)
    assert told in said if told else said == "", said


def test_encodings(tmp_path: Path) -> None:
    titled = TWILL + "[TEXT]\nTitle=Köper; 2/2\n"
    for encoding in ("utf-8", "utf-8-sig", "latin-1", "utf-16"):
        assert read(tmp_path, titled.encode(encoding)).name == "Köper; 2/2"
    assert read(tmp_path, TWILL + "[TEXT]\nTitle=a\x07b\tc\n").name == "a b c"


def test_a_sinking_shed_shows_the_other_face(tmp_path: Path) -> None:
    other = read(tmp_path, TWILL.replace("Rising Shed=1", "Rising Shed=0"))
    assert np.array_equal(other.weave.matrix, 1 - read(tmp_path, TWILL).weave.matrix)


def test_several_shafts_and_treadles_in_a_line(tmp_path: Path) -> None:
    # Skeleton tie-up: one shaft to a treadle, two treadles at once.
    tied = TWILL.replace("1=1,2\n2=2,3\n3=3,4\n4=4,1", "1=1\n2=2\n3=3\n4=4")
    head, tail = tied.split("[TREADLING]")
    tail = tail.replace("=1", "=1,2").replace("=2\n", "=2,3\n").replace("=3\n", "=3,4\n").replace("=4", "=4,1")
    assert "5=1,2" in tail and "2=2,3" in tail
    assert read(tmp_path, head + "[TREADLING]" + tail).weave == read(tmp_path, TWILL).weave
    # An end on shafts 1 and 2 goes up with either: at picks 1, 4 (shaft 1) and 2 (shaft 2).
    both = read(tmp_path, TWILL.replace("[THREADING]\n1=1\n", "[THREADING]\n1=1,2\n"))
    assert both.weave.matrix[:4, 0].tolist() == [0, 0, 1, 0]


def test_colours_of_each_thread(tmp_path: Path) -> None:
    striped = read(tmp_path, TWILL + "[WARP COLORS]\n3=2\n4=2\n7=2\n8=2,1,1,1\n[WEFT COLORS]\n1=1\n")
    red, blue = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    assert striped.warp.colors == (red, red, blue, blue)
    assert striped.weft.colors == (red,) + (blue,) * 7  # the first pick only: no shorter repeat
    grey = read(tmp_path, TWILL.replace("[COLOR TABLE]\n1=255,0,0\n2=0,0,255", "[COLOR TABLE]\n1=128,128,128"))
    np.testing.assert_allclose(grey.warp.colors[0], 0.2158605, rtol=1e-6)  # the published value of sRGB 128
    assert "not in the color table (2): grey is used" in " ".join(grey.warnings)
    own = read(tmp_path, without(TWILL.replace("Color=1", "Color=1,0,255,0"), "COLOR TABLE"))
    assert own.warp.colors[0] == (0, 1, 0) and own.weft.colors == ()
    none = read(tmp_path, without(TWILL, "COLOR TABLE", "COLOR PALETTE").replace("Color=1", ""))
    assert none.warp.colors == () and none.weft.colors == ()


@pytest.mark.parametrize(
    ("unit", "metres"), [("Centimeters", 1e-3), ("inches", 2.54e-3), ('"Decipoints"', 0.1 * 0.0254 / 720)]
)
def test_units(tmp_path: Path, unit: str, metres: float) -> None:
    draft = read(tmp_path, TWILL.replace("Units=Centimeters", f"Units={unit}"))
    assert draft.warp.spacing == pytest.approx(metres)


def test_spacing_and_thickness_of_each_thread(tmp_path: Path) -> None:
    text = TWILL.replace("Spacing=0.1\n", "Spacing=0.1\nThickness=.08\n")
    lines = "".join(f"{k}={'0.3' if k % 4 == 1 else '.1'}\n" for k in range(1, 9))
    draft = read(tmp_path, text + f"[WARP SPACING]\n{lines}[WARP THICKNESS]\n2=0.1\n6=0.1\n")
    assert draft.warp.spacing == pytest.approx(1.5e-3)  # mean of 3, 1, 1, 1 mm
    assert draft.warp.thickness == pytest.approx(0.85e-3)
    assert [w.split(" varies")[0] for w in draft.warnings] == ["the warp's spacing", "the warp's thickness"]
    for change, told in (
        (("Units=Centimeters", "Units=Furlongs"), "no known unit"),
        (("Spacing=0.1", "Spacing=1e9"), "is not believed"),
        (("Spacing=0.1", "Spacing=0.1\nThickness=3"), "its thickness was ignored"),
    ):
        odd = read(tmp_path, TWILL.replace(*change))
        assert told in " ".join(odd.warnings)
    assert odd.warp.spacing == pytest.approx(1e-3) and odd.warp.thickness == 0


# --- round trips -----------------------------------------------------------------------------------------------------

channel = st.integers(0, 255).map(lambda v: float(srgb_to_linear(v / 255)))
colors = st.tuples(channel, channel, channel)
yarns = st.builds(
    lambda radius, colors: YarnParameters(radius=radius, yarn_albedo=tuple(colors)),
    st.floats(5e-5, 1e-3),
    st.lists(colors, min_size=1, max_size=6),
)


@st.composite
def weaves(draw: st.DrawFn) -> Weave:
    if draw(st.booleans()):
        return draw(st.sampled_from(list(NAMED_WEAVES.values())))
    shape = draw(st.tuples(st.integers(2, 8), st.integers(2, 8)))
    matrix = np.array(draw(st.lists(st.integers(0, 1), min_size=shape[0] * shape[1], max_size=shape[0] * shape[1])))
    matrix = matrix.reshape(shape)
    # Every end and pick is bound at least once on each side.
    for k in range(max(shape)):
        matrix[k % shape[0], k % shape[1]] = 1
        matrix[k % shape[0], (k + 1) % shape[1]] = 0
    for lines in (matrix, matrix.T):
        for line in lines:
            if line.min() == line.max():
                return NAMED_WEAVES["plain"]
    return Weave(matrix, "drawn")


fabrics = st.builds(
    FabricParameters,
    weaves(),
    st.tuples(st.floats(2e-3, 0.1), st.floats(2e-3, 0.1)),
    yarns,
    yarns,
    name=st.text(max_size=20),
)


@given(fabric=fabrics)
@settings(deadline=None)
def test_a_written_draft_reads_back_the_same(
    tmp_path_factory: pytest.TempPathFactory, fabric: FabricParameters
) -> None:
    path = write_wif(tmp_path_factory.mktemp("wif") / "a.wif", fabric)
    draft = read_wif(path)
    picks, ends = fabric.repeat()
    assert np.array_equal(draft.weave.matrix, fabric.weave.reduced().matrix)
    for system, number in (("warp", ends), ("weft", picks)):
        own = fabric.system(system).colors()
        read_back = draft.yarns(system).colors
        for k in range(number):
            np.testing.assert_allclose(read_back[k % len(read_back)], own[k % len(own)], atol=1e-12)
        spacing = fabric.cell[0 if system == "warp" else 1]
        width = 2 * fabric.system(system).radius * fabric.system(system).flattening
        np.testing.assert_allclose(draft.yarns(system).spacing, spacing, rtol=1e-5)
        if not any("thickness" in w for w in draft.warnings):
            np.testing.assert_allclose(draft.yarns(system).thickness, width, rtol=1e-5)
    # Woven by its own draft, it makes the same draft again.
    again = read_wif(write_wif(path.with_name("b.wif"), with_draft(fabric, draft)))
    assert np.array_equal(again.weave.matrix, draft.weave.matrix)
    assert (again.warp.colors, again.weft.colors) == (draft.warp.colors, draft.weft.colors)


@pytest.mark.parametrize("name", ["denim", "herringbone", "silk-satin", "cotton-sateen"])
def test_presets_through_wif(tmp_path: Path, name: str) -> None:
    base = preset(name)
    fabric = with_draft(base, read_wif(write_wif(tmp_path / "a.wif", base)))
    assert np.array_equal(fabric.weave.matrix, base.weave.reduced().matrix)
    np.testing.assert_allclose(fabric.cell, base.cell, rtol=1e-5)
    for s in ("warp", "weft"):
        np.testing.assert_allclose(fabric.system(s).radius, base.system(s).radius, rtol=1e-5)
        # Eight bits of sRGB: half a code.
        np.testing.assert_allclose(fabric.system(s).albedo, base.system(s).albedo, atol=0.006)


def test_beyond_the_treadles_of_a_loom_there_is_a_lift_plan(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    matrix = rng.integers(0, 2, (MAX_TREADLES + 8, 20))
    fabric = FabricParameters(Weave(matrix, "dobby"), (0.02, 0.048), YarnParameters(count=20), YarnParameters(count=48))
    assert "[LIFTPLAN]" in wif_text(fabric) and "[TIEUP]" not in wif_text(fabric)
    assert np.array_equal(read_wif(write_wif(tmp_path / "a.wif", fabric)).weave.matrix, matrix)


def test_files_are_what_the_specification_asks_for() -> None:
    ini = parse_ini(wif_text(preset("denim")))
    assert {k: ini.section("WIF")[k] for k in ("version", "date")} == {"version": "1.1", "date": "April 20, 1997"}
    assert {"developers", "source program"} <= set(ini.section("WIF"))
    assert {k.upper() for k in ini.section("CONTENTS")} == set(ini.sections) - {"WIF", "CONTENTS"}
    assert ini.notes == ()


def test_outputs_that_are_refused(tmp_path: Path) -> None:
    path = write_wif(tmp_path / "a.wif", preset("linen"))
    with pytest.raises(UsdfabError, match="the file exists"):
        write_wif(path, preset("linen"))
    with pytest.raises(UsdfabError, match=r"use \.wif"):
        write_wif(tmp_path / "a.txt", preset("linen"))
    many = tuple((k / 5000, 0.5, 0.5) for k in range(4999))
    with pytest.raises(UsdfabError, match="repeat after"):
        write_wif(tmp_path / "b.wif", replace(preset("linen"), warp=YarnParameters(yarn_albedo=many)))
    assert [p.name for p in tmp_path.iterdir()] == ["a.wif"]


# --- hostile files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (b"", "empty"),
        (b" \r\n\t ", "empty"),
        (b"\x89PNG\r\n\0\0\0", "binary"),
        ("hello", "no .SECTION."),
        ("[WIF]\nVersion=1.1\n", "no draft in this file"),
        ("[WEAVING]\nShafts=4\n", "no threading"),
        ("[THREADING]\n1=1\n2=2\n", "no lift plan"),
        (TWILL.replace("Threads=8", "Threads=1000000000"), "above 4096"),
        (TWILL.replace("Threads=8", "Threads=99999999999999999999999999"), "not a whole number"),
        (TWILL.replace("Threads=8", "Threads=-3"), r"\[WARP\] Threads: '-3' is not a whole number"),
        (TWILL.replace("Threads=8", "Threads=nan"), "'nan' is not a whole number"),
        (TWILL.replace("Shafts=4", "Shafts=1e3"), "'1e3' is not a whole number"),
        (TWILL.replace("3=3\n4=4\n5", "3=900000000\n4=4\n5"), r"\[THREADING\] 3: 900000000 is above 4096"),
        (TWILL.replace("2=2,3", "2=2,x"), r"\[TIEUP\] 2: 'x' is not a whole number"),
        (TWILL.replace("Spacing=0.1", "Spacing=NaN"), r"\[WARP\] Spacing: 'NaN' is not a number"),
        (TWILL.replace("Spacing=0.1", "Spacing=inf"), "not a number"),
        (TWILL.replace("Spacing=0.1", "Spacing=-1"), "-1 is below 0"),
        (TWILL.replace("Spacing=0.1", "Spacing=" + "9" * 5000), "not a number"),
        (TWILL.replace("Range=0,255", "Range=5,5"), "no range of colours"),
        (TWILL.replace("Range=0,255", "Range=0"), "no range of colours"),
        (TWILL.replace("1=255,0,0", "1=255,0"), "three numbers R,G,B"),
        (TWILL.replace("1=255,0,0", "1=red"), "'red' is not a number"),
        (TWILL.replace("Color=1", "Color=first"), "'first' is not a whole number"),
        (re.sub("(?m)=[1-4]$", "=0", TWILL), "no thread has an entry"),
        (TWILL.replace("4=4,1", "4=1,2,3,4"), r"pick 4 never interlaces"),
        (without(TWILL, "TIEUP", "LIFTPLAN"), "no treadling with a tie-up"),
    ],
)  # fmt: skip
def test_files_that_are_no_draft(tmp_path: Path, text: str | bytes, problem: str) -> None:
    with pytest.raises(UsdfabError, match=problem) as caught:
        read(tmp_path, text)
    assert "draft.wif" in str(caught.value) and "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for name, problem in (("none.wif", "does not exist"), (".", "folder")):
        with pytest.raises(UsdfabError, match=problem):
            read_wif(tmp_path / name)
    with pytest.raises(UsdfabError, match="larger than 8 MB"):
        read(tmp_path, b"[WIF]\n" + b"; " * 8_500_000)
    assert decode(b"a\xff") == "aÿ"


def test_the_largest_drafts_take_seconds_not_memory(tmp_path: Path) -> None:
    # A straight draw over all shafts there may be, each pick lifting another shaft: 4096 x 4096 without a repeat.
    threads = "\n".join(f"{k}={k}" for k in range(1, MAX_THREADS + 1))
    text = f"[WEAVING]\nRising Shed=1\n[THREADING]\n{threads}\n[LIFTPLAN]\n{threads}\n"
    with pytest.raises(UsdfabError, match="repeats after 4096 picks and 4096 ends, above 512"):
        read(tmp_path, text)


def test_broken_drafts_are_refused_or_read(tmp_path: Path) -> None:
    """A thousand damaged files: each is a draft or one clear line."""
    base = SAMPLE.read_bytes()
    rng = random.Random(7)
    outcomes = {"read": 0, "refused": 0}
    for trial in range(1000):
        data = bytearray(base)
        kind = trial % 5
        if kind == 0:
            data = data[: rng.randrange(len(data))]
        elif kind == 1:
            for _ in range(rng.randrange(1, 30)):
                data[rng.randrange(len(data))] = rng.randrange(256)
        elif kind == 2:
            begin = rng.randrange(len(data))
            del data[begin : begin + rng.randrange(200)]
        elif kind == 3:
            lines = data.split(b"\n")
            rng.shuffle(lines)
            data = bytearray(b"\n".join(lines))
        else:
            lines = data.split(b"\n")
            for _ in range(8):
                at = rng.randrange(len(lines))
                key = lines[at].split(b"=")[0]
                odd = (b"-1", b"1e99", b"", b"0", b"99999", b"nan", b",,,", b"\xff", b"1,2,3,4,5", b"]", b"[", b"=")
                lines[at] = key + b"=" + rng.choice(odd)
            data = bytearray(b"\n".join(lines))
        try:
            draft = read(tmp_path, bytes(data))
        except UsdfabError as error:
            assert "\n" not in str(error)
            outcomes["refused"] += 1
        else:
            fabric = with_draft(FabricParameters(), draft)
            assert fabric.weave.picks >= 2
            outcomes["read"] += 1
    assert min(outcomes.values()) > 100, outcomes  # the damage is neither always harmless nor always fatal


@given(st.text(st.sampled_from("[]=;,\n\r 0129-.eThreadsWARPCOL\0é"), max_size=300))
@settings(deadline=None)
def test_garbage_is_refused_in_one_line(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    with pytest.raises(UsdfabError) as caught:
        read(tmp_path_factory.mktemp("garbage"), text)
    assert "\n" not in str(caught.value)


def test_a_weave_of_names_survives(tmp_path: Path) -> None:
    fabric = FabricParameters(weave_from_name("plain"), name="two\nlines\x00")
    assert read_wif(write_wif(tmp_path / "a.wif", fabric)).name == "two lines"
