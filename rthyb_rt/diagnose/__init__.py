"""Diagnosis: when simulation and recording differ, say what physics the model leaves out."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _Room(ModuleType):
    """The room of the diagnosis, which is the public function of the same name as well."""

    def __call__(self, *args: Any, **named: Any) -> Any:
        """Say what physics a model leaves out; `rthyb_rt.api.diagnosing.diagnose`."""
        from rthyb_rt.api.diagnosing import diagnose

        return diagnose(*args, **named)


sys.modules[__name__].__class__ = _Room
