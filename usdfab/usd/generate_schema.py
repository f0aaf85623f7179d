"""Writes ``schema.usda``, ``generatedSchema.usda`` and ``plugInfo.json``: ``python -m usdfab.usd.generate_schema``.

A developer's tool; it runs USD's own ``usdGenSchema``, which needs jinja2.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import usdfab
from usdfab.errors import UsdfabError
from usdfab.usd.schema_source import schema_source

SCHEMA_FILES = ("schema.usda", "generatedSchema.usda", "plugInfo.json")
_PLACEHOLDERS = {"@PLUG_INFO_LIBRARY_PATH@": "", "@PLUG_INFO_RESOURCE_PATH@": ".", "@PLUG_INFO_ROOT@": "."}


def generate_schema(folder: Path) -> list[Path]:
    """Write the three schema files into ``folder`` and return their paths.

    Raises
    ------
    UsdfabError
        If usdGenSchema fails; its last line says why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "schema.usda"
    source.write_text(schema_source(), encoding="utf-8")
    # Own process, without any plug-in path: usdGenSchema must not meet the schema that it is about to write.
    environment = {k: v for k, v in os.environ.items() if k != "PXR_PLUGINPATH_NAME"}
    command = [sys.executable, "-m", "pxr.Usd.usdGenSchema", source.name, "."]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise UsdfabError(f"usdGenSchema failed: {lines[-1]}", place=str(source), remedy="is jinja2 installed?")
    info = folder / "plugInfo.json"
    text = info.read_text(encoding="utf-8")
    for placeholder, value in _PLACEHOLDERS.items():
        text = text.replace(placeholder, value)
    info.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
    return [folder / name for name in SCHEMA_FILES]


def main() -> None:
    """Regenerate the schema in the folder given as the only argument, or in usdfab's own."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else usdfab.schema_dir()
    for path in generate_schema(folder):
        print(path)


if __name__ == "__main__":
    main()
