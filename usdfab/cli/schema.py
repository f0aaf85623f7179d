"""``usdfab schema``: where the USD schema is."""

from __future__ import annotations


def run() -> None:
    """Print the folder of usdfab's USD schema, so that other USD programs can read fabrics with their fallbacks.

    Usage examples:

        export PXR_PLUGINPATH_NAME="$(usdfab schema):$PXR_PLUGINPATH_NAME"
    """
    from usdfab import schema_dir

    print(schema_dir())
