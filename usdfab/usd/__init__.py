"""The only part of usdfab that speaks ``pxr``: schema, fabric assets, reading stages, rigs, expansion, checks.

Importing this package registers usdfab's USD schema (:mod:`usdfab.usd.registration`); import it before any stage is
opened.
"""

from usdfab.usd.registration import register as register, require_schema as require_schema

register()
