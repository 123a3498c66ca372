"""Mappings that cannot change, and that can be sent to another process or copied."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any


def read_only(given: Mapping[str, Any]) -> Mapping[str, Any]:
    """A view on a copy of a mapping."""
    return MappingProxyType(dict(given))


# Python itself does not pickle such views
copyreg.pickle(MappingProxyType, lambda view: (read_only, (dict(view),)))  # type: ignore
