"""usdfab: from one microscope photo of a woven fabric to a USD asset made of fibers."""

from pathlib import Path

from usdfab._version import __version__ as __version__
from usdfab.errors import UsdfabError as UsdfabError


def schema_dir() -> Path:
    """Folder that holds usdfab's USD schema (``plugInfo.json``); put it on ``PXR_PLUGINPATH_NAME``.

    Does not import ``pxr``, so that any host may ask before it starts USD.
    """
    package = Path(__file__).resolve().parent
    installed = package / "schemas"
    return installed if installed.is_dir() else package.parent / "schemas"
