"""Real-time hybrid testing controller.

Part of a structure is real, on an actuator; the rest is computed. 1024 times a second the
controller reads the specimen, solves the equation of motion, compensates the actuator's delay and
sends the next command.

`__all__` is the complete public interface: ``import rthyb_rt as rt``. Everything else that can be
imported may change with any version. Importing the package itself loads nothing; a name is
imported when it is first used.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rthyb_rt.analysis.balance import EnergyBalance
    from rthyb_rt.analysis.spectra import FrequencyResponse
    from rthyb_rt.api.checking import Check, RigCheck, check
    from rthyb_rt.api.comparing import Comparison, compare
    from rthyb_rt.api.diagnosing import Diagnosis, diagnose
    from rthyb_rt.api.files import Rig, Test
    from rthyb_rt.api.identifying import AxesIdentification, Identification, identify
    from rthyb_rt.api.recordings import Plot, Plots, Recording
    from rthyb_rt.api.recordings import open_recording as open
    from rthyb_rt.api.replaying import replay
    from rthyb_rt.api.running import run
    from rthyb_rt.api.sweeping import Sweep, sweep
    from rthyb_rt.core.own import ControlLaw, Element, NumericalPart
    from rthyb_rt.diagnose.effects.base import Context, Effect, Param, Trial
    from rthyb_rt.errors import InputError, Problem, RthybError
    from rthyb_rt.lab.experiment import Replay

__all__ = [
    "AxesIdentification",
    "Check",
    "Comparison",
    "Context",
    "ControlLaw",
    "Diagnosis",
    "Effect",
    "Element",
    "EnergyBalance",
    "FrequencyResponse",
    "Identification",
    "InputError",
    "NumericalPart",
    "Param",
    "Plot",
    "Plots",
    "Problem",
    "Recording",
    "Replay",
    "Rig",
    "RigCheck",
    "RthybError",
    "Sweep",
    "Test",
    "Trial",
    "__version__",
    "check",
    "compare",
    "diagnose",
    "identify",
    "open",
    "replay",
    "run",
    "sweep",
]

_HOMES = {
    "AxesIdentification": "api.identifying",
    "Check": "api.checking",
    "Comparison": "api.comparing",
    "Context": "diagnose.effects.base",
    "ControlLaw": "core.own",
    "Diagnosis": "api.diagnosing",
    "Effect": "diagnose.effects.base",
    "Element": "core.own",
    "EnergyBalance": "analysis.balance",
    "FrequencyResponse": "analysis.spectra",
    "Identification": "api.identifying",
    "InputError": "errors",
    "NumericalPart": "core.own",
    "Param": "diagnose.effects.base",
    "Plot": "api.recordings",
    "Plots": "api.recordings",
    "Problem": "errors",
    "Recording": "api.recordings",
    "Replay": "lab.experiment",
    "Rig": "api.files",
    "RigCheck": "api.checking",
    "RthybError": "errors",
    "Sweep": "api.sweeping",
    "Test": "api.files",
    "Trial": "diagnose.effects.base",
    "check": "api.checking",
    "compare": "api.comparing",
    "diagnose": "api.diagnosing",
    "identify": "api.identifying",
    "open": "api.recordings",
    "replay": "api.replaying",
    "run": "api.running",
    "sweep": "api.sweeping",
}
"""Module in which each name is defined."""
_NAMES = {"open": "open_recording"}
"""Original names of those that have another name here."""

__version__: str


def defined(name: str) -> Any:
    """Return what a public name stands for, imported from the module in which it is defined.

    Raises:
        KeyError: no public name.
    """
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), _NAMES.get(name, name))


if not TYPE_CHECKING:  # otherwise mypy would assume that the package has every attribute

    def __getattr__(name: str) -> object:
        """Import a name on first use, because each import takes time."""
        if name == "__version__":
            from importlib.metadata import version

            return version("rthyb-rt")
        if name == "diagnose":
            # The package of that name calls the function; importing it makes it an attribute.
            return import_module(f"{__name__}.diagnose")
        if name not in _HOMES:
            # With these two, Python names the attribute that was meant.
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}",
                name=name,
                obj=sys.modules[__name__],
            )
        found = defined(name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        """Return the public names."""
        return sorted(__all__)
