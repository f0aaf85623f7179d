"""Damaged stages never kill the process, never hang it, and never end in a traceback: a watchdog and 600 cases."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

WORKER = Path(__file__).parent / "fuzz_worker.py"
CASES = 600
PATIENCE_S = 120.0
"""A case takes a fraction of a second; loading or compiling kernels may come on top."""


def watch(folder: Path, first: int, last: int) -> tuple[list[str], list[str]]:
    """Outcomes of the cases, and what went wrong; a process that dies or hangs is replaced after the guilty case."""
    outcomes: list[str] = []
    faults: list[str] = []
    while first < last:
        with (folder / "stderr.txt").open("w") as errors:
            command = [sys.executable, str(WORKER), str(folder), str(first), str(last)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
            lines: queue.Queue[str] = queue.Queue()
            reader = threading.Thread(target=_read, args=(process.stdout, lines))
            reader.start()
            while True:
                try:
                    line = lines.get(timeout=PATIENCE_S)
                except queue.Empty:
                    process.kill()
                    faults.append(f"case {first} hangs")
                    first += 1
                    break
                if not line:
                    if process.wait() != 0 or first < last:
                        faults.append(f"case {first} ends the process with {process.returncode}")
                        first += 1
                    break
                word, number, *rest = line.rstrip("\n").split(" ", 2)
                if word == "end":
                    first = int(number) + 1
                    outcomes.append(rest[0])
                    if rest[0].startswith("broken"):
                        faults.append(f"case {number}: {rest[0]}")
            process.wait()
            reader.join()
        if len(faults) > 20:
            break
    return outcomes, faults


def _read(stream: Iterable[str], lines: queue.Queue[str]) -> None:
    for line in stream:
        lines.put(line)
    lines.put("")


def test_damaged_stages_end_in_one_line(tmp_path: Path) -> None:
    cases = int(os.environ.get("USDFAB_FUZZ_CASES", CASES))
    outcomes, faults = watch(tmp_path, 0, cases)
    assert not faults, "\n".join(faults)
    kinds = Counter(outcome.rsplit(" ", 1)[0] for outcome in outcomes)
    # Every command was tried on many files, and both ends are met: damage that matters and damage that does not.
    assert min(kinds[f"ok {name}"] for name in ("check", "info", "edit", "bind", "expand", "render")) >= cases // 30
    codes = Counter(outcome.rsplit(" ", 1)[1] for outcome in outcomes)
    assert codes["0"] > cases // 10 and codes["2"] > cases // 10


def test_the_watchdog_barks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A case that hangs and one that kills the process are found, and the others are run all the same."""
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import os, sys, time\n"
        "for k in range(int(sys.argv[2]), int(sys.argv[3])):\n"
        "    print('begin', k, flush=True)\n"
        "    if k == 1: time.sleep(60)\n"
        "    if k == 3: os.abort()\n"
        "    print('end', k, 'broken' if k == 4 else 'ok check 0', flush=True)\n"
    )
    monkeypatch.setattr(sys.modules[__name__], "WORKER", worker)
    monkeypatch.setattr(sys.modules[__name__], "PATIENCE_S", 3.0)
    outcomes, faults = watch(tmp_path, 0, 6)
    assert outcomes == ["ok check 0", "ok check 0", "broken", "ok check 0"]
    assert [fault.split()[1:3] for fault in faults] == [["1", "hangs"], ["3", "ends"], ["4:", "broken"]]
