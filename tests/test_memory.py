"""Free memory as a bound: what asks for more is refused, and the process goes on."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from usdfab.memory import available_memory, bounded_memory


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="free memory and its bound are Linux's")
def test_more_than_is_free_is_refused_and_the_bound_is_lifted():
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    free = available_memory()
    assert free is not None and free > 0
    with bounded_memory():
        assert np.ones(1000).sum() == 1000
        with pytest.raises(MemoryError):
            np.empty(2 * free, dtype=np.uint8)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
    # Pages that nobody touches cost nothing: without the bound this is allowed, as overcommitment goes.
    with pytest.raises(ZeroDivisionError), bounded_memory():
        raise ZeroDivisionError
    assert resource.getrlimit(resource.RLIMIT_AS) == before
