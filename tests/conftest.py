"""Shared by all tests. usdfab.usd is imported first: the schema must be registered before any stage exists."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "2")

from hypothesis import HealthCheck, settings

import usdfab.usd
from usdfab.mi.variant import prepare

# Tests that ask for mitsuba by its own name import Dr.Jit, which takes the first LLVM library that it finds.
prepare()

settings.register_profile("usdfab", deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("usdfab")

assert usdfab.usd.__name__ == "usdfab.usd"
