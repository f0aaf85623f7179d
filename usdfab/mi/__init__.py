"""Mitsuba 3 as a second renderer, and the one that differentiates. The only package that imports `mitsuba`.

Nothing is imported here: which LLVM library Dr.Jit takes has to be settled before `mitsuba` and `drjit` are loaded.
"""
