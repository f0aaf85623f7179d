"""Runs commands of usdfab on damaged stages, one case after the other, and says of each how it ended.

    python fuzz_worker.py FOLDER FIRST LAST

Writes one line when a case begins and one when it ends, so that whoever reads them knows which one hangs or kills the
process. A case is a pure function of its number: the base file, the damage and the command all come from it.
"""

from __future__ import annotations

import io
import random
import re
import sys
import traceback
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e-300", "1e39", "1e300", "2147483647", "4294967296", "999999999999")
TYPES = (
    "double", "float", "int", "token", "string", "asset", "bool", "color3d", "color3f[]", "point3f[]", "int[]",
    "token[]", "texCoord2f[]", "matrix4d", "double[]", "rel",
)  # fmt: skip
STRINGS = ('""', '"../../x"', '"plain"', '"\\u0000"', '"日本語 \\n"', '"' + "x" * 5000 + '"', '"inherited"', '"vertex"')
ASSETS = (
    "@@", "@.@", "@./{name}@", "@./missing.usda@", "@./missing.png@", "@/dev/null@", "@./text.usda@", "@{name}[x]@",
)  # fmt: skip
ARCS = (
    "prepend references = @./{name}@</World>",
    "prepend references = </World>",
    "prepend payload = @./{name}@",
    "inherits = </World>",
    "specializes = </World/Looks>",
    "prepend references = @./missing.usda@",
    "instanceable = true",
    "active = false",
    'kind = "nonsense"',
    'variants = { string colorway = "missing" }',
)


def bases(folder: Path) -> dict[str, Path]:
    """The files that are damaged: a fabric, a stage of everything, a bound stage; written once."""
    from production import showroom

    from usdfab.fabric import FabricParameters, YarnParameters
    from usdfab.usd.bind import bind
    from usdfab.usd.fabric_io import write_fabric

    files = {name: folder / name for name in ("fabric.usda", "stage.usda", "bound.usda", "fabric.usdc", "stage.usdc")}
    if not all(file.exists() for file in files.values()):
        yarn = YarnParameters(count=6, radius=2e-4, fiber_count=4)
        write_fabric(FabricParameters(size=(3e-3, 3e-3), warp=yarn, weft=yarn), files["fabric.usda"], overwrite=True)
        write_fabric(FabricParameters(size=(3e-3, 3e-3), warp=yarn, weft=yarn), files["fabric.usdc"], overwrite=True)
        stage = showroom(Path("missing.png"), ("DomeLight", "SphereLight")).stage
        stage.Export(str(files["stage.usda"]))
        stage.Export(str(files["stage.usdc"]))
        bind(files["stage.usda"], files["fabric.usda"], files["bound.usda"], prims=["/World/Shown"], overwrite=True)
        (folder / "text.usda").write_text("no layer\n")
    return files


def damaged(data: bytes, name: str, chance: random.Random) -> bytes:
    """The file with one to four faults of one kind or several."""
    if not data.startswith(b"#usda"):
        return _damaged_bytes(data, chance)
    text = data.decode()
    for _ in range(chance.randint(1, 4)):
        damage = chance.choice((_truncate, _lines, _numbers, _types, _strings, _assets, _arcs, _names))
        text = damage(text, name, chance)
    encoded = text.encode(errors="replace")
    return _damaged_bytes(encoded, chance) if chance.random() < 0.1 else encoded


def _damaged_bytes(data: bytes, chance: random.Random) -> bytes:
    if chance.random() < 0.5:
        return data[: chance.randrange(len(data))]
    out = bytearray(data)
    for _ in range(chance.randint(1, 20)):
        out[chance.randrange(len(out))] = chance.randrange(256)
    return bytes(out)


def _truncate(text: str, name: str, chance: random.Random) -> str:
    return text[: chance.randrange(len(text))] if chance.random() < 0.3 else text


def _lines(text: str, name: str, chance: random.Random) -> str:
    lines = text.splitlines(keepends=True)
    i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
    what = chance.randrange(3)
    if what == 0:
        del lines[i]
    elif what == 1:
        lines.insert(j, lines[i])
    else:
        lines[i], lines[j] = lines[j], lines[i]
    return "".join(lines)


def _substitute(pattern: str, new: str, text: str, chance: random.Random) -> str:
    """One match of the pattern replaced."""
    found = list(re.finditer(pattern, text))
    if not found:
        return text
    match = chance.choice(found)
    return text[: match.start()] + new + text[match.end() :]


def _numbers(text: str, name: str, chance: random.Random) -> str:
    return _substitute(r"(?<![\w.])-?\d+(\.\d+)?(e-?\d+)?(?![\w.])", chance.choice(NUMBERS), text, chance)


def _types(text: str, name: str, chance: random.Random) -> str:
    return _substitute(
        r"(?<=\s)(double|float|int|token|color3[df](\[\])?|point3f\[\]|texCoord2f\[\]|int\[\]|matrix4d)(?=\s)",
        chance.choice(TYPES), text, chance,
    )  # fmt: skip


def _strings(text: str, name: str, chance: random.Random) -> str:
    return _substitute(r'(?<== )"[^"\n]*"', chance.choice(STRINGS), text, chance)


def _assets(text: str, name: str, chance: random.Random) -> str:
    return _substitute(r"@[^@\n]*@", chance.choice(ASSETS).replace("{name}", name), text, chance)


def _arcs(text: str, name: str, chance: random.Random) -> str:
    arc = chance.choice(ARCS).replace("{name}", name)
    heads = list(re.finditer(r'(def|over|class) [^\n]*"[^"\n]*"[ \t]*\(?\n', text))
    if not heads:
        return text
    match = chance.choice(heads)
    head = match.group().rstrip()
    new = f"{head}\n{arc}\n" if head.endswith("(") else f"{head} (\n{arc}\n)\n"
    return text[: match.start()] + new + text[match.end() :]


def _names(text: str, name: str, chance: random.Random) -> str:
    paths = [*re.findall(r"<(/[^>\n]*)>", text), "/World", "/World/Missing", "/"]
    return _substitute(r"<(/[^>\n]*)>", f"<{chance.choice(paths)}>", text, chance)


def command(file: Path, other: Path, out: Path, chance: random.Random) -> list[str]:
    """A command line on the damaged file."""
    fabric = "fabric" in file.name
    kinds = ["check", "info", "edit", "render"] if fabric else ["check", "info", "bind", "expand", "render", "render"]
    kind = chance.choice(kinds)
    small = ["--resolution", "6x4", "--spp", "1", "--max-depth", "4", "--quiet", "--overwrite"]
    return {
        "check": ["check", str(file), "--json"],
        "info": ["info", str(file), "--json"],
        "edit": ["edit", str(file), "--set", "warp.albedo=.1,.2,.3", "-o", str(out / "edited.usda"), "--overwrite"],
        "bind": ["bind", str(file), str(other), "-o", str(out / "b.usda"), "--all", "--overwrite", "--json"],
        "expand": ["expand", str(file), "-o", str(out / "e.usdc"), "--overwrite", "--vertices-per-segment", "6"],
        "render": ["render", str(file), "-o", str(out / "r.png"), *small],
    }[kind]


def run_case(number: int, folder: Path, files: dict[str, Path]) -> str:
    """How a case ended: its exit code, or a traceback."""
    from usdfab.cli.main import _run

    chance = random.Random(number)
    base = chance.choice(sorted(files))
    file = folder / f"case_{base}"
    file.write_bytes(damaged(files[base].read_bytes(), file.name, chance))
    arguments = command(file, files["fabric.usda"], folder, chance)
    talk = io.StringIO()
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(talk), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = _run(arguments)
    except Exception:  # noqa: BLE001 - this is what the test is about
        return f"broken {arguments[0]} {traceback.format_exc()!r}"
    said = talk.getvalue().strip().splitlines() or [""]
    # USD's own bindings may talk before.
    if code == 2 and arguments[0] != "check" and not said[-1].startswith("usdfab: "):
        return f"broken {arguments[0]} exit code 2 without a reason: {said!r}"
    return f"ok {arguments[0]} {code}"


def main() -> None:
    """Run the cases FIRST to LAST, the last not included."""
    folder, first, last = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    if sys.platform.startswith("linux"):
        # What a damaged file asks for may be all there is; others work on this machine too.
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, resource.getrlimit(resource.RLIMIT_AS)[1]))
    files = bases(folder)
    for number in range(first, last):
        print(f"begin {number}", flush=True)
        print(f"end {number} {run_case(number, folder, files)}", flush=True)


if __name__ == "__main__":
    main()
