"""What JSON documents have in common."""

from __future__ import annotations

import math
from typing import Any


def finite(value: Any) -> Any:
    """Return a copy of a document in which each number that JSON does not have is None."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
