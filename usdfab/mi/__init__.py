"""Mitsuba 3 as a second renderer; the only package that imports ``mitsuba`` and ``drjit``.

Importing this package loads neither: ``usdfab.mi.variant.load`` does, after it has found a library that works.
"""
