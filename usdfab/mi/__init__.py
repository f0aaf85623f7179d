"""Mitsuba 3 as a second renderer, and the one that differentiates. The only package that imports ``mitsuba``.

Importing this package loads nothing: ``usdfab.mi.variant.load`` does, after it has found a library that works.
"""
