"""Registering usdfab's codeless USD schema, once, before USD's schema registry starts.

USD reads schema plug-ins when the first stage (or ``Usd.SchemaRegistry``) comes into being and never again. So the
schema is registered when ``usdfab.usd`` is imported; whether that was early enough is asked only when somebody needs
the schema, because asking starts the registry and would lock out the schemas of packages imported later.
"""

from __future__ import annotations

from functools import cache

from pxr import Plug, Usd

import usdfab
from usdfab.errors import UsdfabError

FABRIC_API = "UsdfabFabricAPI"
"""Single-apply schema on a Material: what the cloth has once."""
YARN_API = "UsdfabYarnAPI"
"""Multiple-apply schema on a Material, instances ``warp`` and ``weft``: one yarn system each."""


def usd_version() -> str:
    """Version of the USD library that runs here, for example ``"26.11"``; not always that of the package."""
    _, minor, patch = Usd.GetVersion()
    return f"{minor}.{patch:02d}"


def register() -> None:
    """Make the schema known to USD. Harmless when repeated, and when PXR_PLUGINPATH_NAME has it already."""
    # A copy that the host put on PXR_PLUGINPATH_NAME wins: two copies of one type would be an error in the host.
    if Plug.Registry().GetPluginWithName("usdfab") is None:
        Plug.Registry().RegisterPlugins(str(usdfab.schema_dir()))


@cache
def _schema_known() -> bool:
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(FABRIC_API)
    return definition is not None


def require_schema() -> None:
    """Raise ``UsdfabError`` unless USD knows the schema. Starts USD's schema registry."""
    if _schema_known():
        return
    folder = usdfab.schema_dir()
    if not (folder / "plugInfo.json").is_file():
        raise UsdfabError("usdfab's USD schema is missing", place=str(folder), remedy="reinstall usdfab")
    raise UsdfabError(
        "USD's schema registry was started before usdfab registered its schema",
        remedy=f"import usdfab.usd before any stage is opened, or start with PXR_PLUGINPATH_NAME={folder}",
    )
