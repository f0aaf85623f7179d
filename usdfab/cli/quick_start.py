"""Less to load, less to search and less to tidy up: what a command takes besides its work."""

from __future__ import annotations

import atexit
import gc
import os
import sys
import threading
from typing import NoReturn

_UNUSED = "scipy.linalg.cython_blas"
"""What Numba looks for when it is loaded, to know whether there is a BLAS: that takes as long as loading all of NumPy,
and no kernel of usdfab multiplies matrices. A kernel that did would still find it when it is compiled."""


def collect_rarely() -> None:
    """Let the garbage collector look at what is alive less often.

    Loading modules makes a few hundred thousand objects that stay; searching them over and over takes a fifth of the
    time until a picture appears.
    """
    gc.set_threshold(200_000, 20, 20)


def load_numba() -> None:
    """Load Numba without SciPy's linear algebra, unless one of them is there already."""
    if "numba" in sys.modules or _UNUSED in sys.modules:
        return
    sys.modules[_UNUSED] = None  # type: ignore[assignment]  # Python's way to say that there is no such module
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[_UNUSED]


def leave(code: int) -> NoReturn:
    """End the process, without taking apart what its end frees anyway: half a second for a million objects.

    What asked to be told of the end is told. While other threads are at work the process ends as usual.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    if threading.active_count() == 1:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    raise SystemExit(code)
