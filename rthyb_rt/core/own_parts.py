"""User-defined numerical parts of every kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rthyb_rt.core.own import PythonPartConfig
from rthyb_rt.core.own_fmu import FmuConfig
from rthyb_rt.core.own_library import LibraryConfig

OwnPartConfig = LibraryConfig | FmuConfig | PythonPartConfig

KINDS: Final[dict[str, type[LibraryConfig | FmuConfig | PythonPartConfig]]] = {
    kind.kind: kind for kind in (LibraryConfig, FmuConfig, PythonPartConfig)
}


def of_plain(plain: Mapping[str, Any]) -> OwnPartConfig:
    """Return the settings of a part from a recording; raises ``KeyError`` or similar."""
    return KINDS[plain["kind"]].of_plain(plain)
