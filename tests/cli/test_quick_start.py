"""Starting and ending commands in a hurry: nothing that anybody relies on may be lost by it."""

import subprocess
import sys
from pathlib import Path

import pytest

DRAPE = Path(__file__).parents[2] / "samples" / "drape.usda"


def python(script: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("code", [0, 3])
def test_leave_tells_who_asked_and_flushes(code):
    done = python(
        "import atexit, sys, tempfile, weakref\n"
        "from usdfab.cli.quick_start import leave\n"
        "class Thing: pass\n"
        "thing = Thing()\n"
        "weakref.finalize(thing, print, 'finalised')\n"
        "atexit.register(print, 'last word', file=sys.stderr)\n"
        "folder = tempfile.TemporaryDirectory()\n"
        "print(folder.name)\n"
        f"leave({code})\n"
    )
    assert done.returncode == code
    folder, said = done.stdout.split()
    assert said == "finalised" and done.stderr == "last word\n"
    assert python(f"import os; assert not os.path.exists({folder!r})").returncode == 0


def test_leave_waits_for_threads():
    done = python(
        "import threading, time\n"
        "from usdfab.cli.quick_start import leave\n"
        "threading.Thread(target=lambda: (time.sleep(0.3), print('done'))).start()\n"
        "leave(5)\n"
    )
    assert (done.returncode, done.stdout) == (5, "done\n")


def test_numba_without_scipys_linear_algebra_still_multiplies_matrices():
    done = python(
        "import sys\n"
        "from usdfab.cli.quick_start import load_numba\n"
        "load_numba()\n"
        "assert 'numba' in sys.modules\n"
        "assert 'scipy.linalg' not in sys.modules and 'scipy.linalg.cython_blas' not in sys.modules\n"
        "import numba, numpy as np\n"
        "a = np.arange(6.0).reshape(2, 3)\n"
        "assert np.array_equal(numba.njit(lambda x: x @ x.T)(a), a @ a.T)\n"
        "import scipy.linalg.cython_blas\n"
        "load_numba()\n"
    )
    assert done.returncode == 0, done.stderr


def test_a_render_of_surfaces_loads_no_scipy_parts(tmp_path):
    """What made the first picture slow is not to come back unseen."""
    done = python(
        "import sys\n"
        "from usdfab.cli.main import _run\n"
        f"arguments = [{str(DRAPE)!r}, '--resolution', '8', '--spp', '1', '--quiet']\n"
        f"assert _run(['render', *arguments, '-o', {str(tmp_path / 'x.png')!r}]) == 0\n"
        "heavy = {'scipy.linalg', 'scipy.special', 'torch', 'mitsuba', 'numpy.f2py'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    assert done.returncode == 0, done.stderr
