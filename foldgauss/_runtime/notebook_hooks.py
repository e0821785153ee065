"""Notebook displays of objects: functions registered by name, so that no class imports a plotting module.

`foldgauss/__init__.py` registers them; a module is imported when a notebook first shows an object of its kind.
"""

import importlib
from typing import Any

_LOCATIONS: dict[str, str] = {}


def register(kind: str, location: str) -> None:
    """Show objects of `kind` with the function at `location`, as "package.module:function"."""
    _LOCATIONS[kind] = location


def show(kind: str, obj: Any) -> Any:
    """Call the function registered for `kind` with `obj`."""
    module, _, function = _LOCATIONS[kind].partition(":")
    return getattr(importlib.import_module(module), function)(obj)
