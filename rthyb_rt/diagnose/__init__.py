"""Diagnosis: find the physics that a model lacks when simulation and recording differ."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import rthyb_rt


class _Room(ModuleType):
    """The package of the diagnosis, which is also the public function of the same name."""

    def __call__(self, *args: Any, **named: Any) -> Any:
        """Find the physics that a model lacks: the public function of the package above."""
        return rthyb_rt.defined("diagnose")(*args, **named)


sys.modules[__name__].__class__ = _Room
