"""The thin face of the C core: ndarrays and dataclasses in, ndarrays out.

Only this package and `rthyb_rt.record.ring` touch cffi. SI units throughout. What most of the
program needs has its name here; ticker, loop, wire, signal tables and the numerical parts are
modules of their own.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rthyb_rt.core.controller import (
        Controller,
        Sample,
    )
    from rthyb_rt.core.kernels import (
        Element,
        Estimator,
        Law,
        Motion,
        Plc,
        Rfc,
        Rig,
        element_array,
        finite_motion,
        plc_is_stable,
    )
    from rthyb_rt.core.library import (
        STATUS,
        CoreError,
        FloatArray,
        RecordArray,
        build_facts,
        status_names,
        version,
    )
    from rthyb_rt.core.rows import (
        CHANNELS_MAX,
        COMMAND_BIT,
        FLAG_NAMES,
        FLAGS,
        RECORD_DTYPE,
        RUNNING,
        STATES,
        Channel,
        as_records,
        check_channels,
        dtype_of,
        row_dtype,
        rows_of,
    )
    from rthyb_rt.core.settings import (
        ELEMENT_PARAMS,
        ControllerConfig,
        DenseConfig,
        DenseIntegrator,
        Divisor,
        ElementConfig,
        EstimatorConfig,
        EstimatorLaw,
        ExtraSensorConfig,
        Hold,
        Integrator,
        LawConfig,
        LoadCell,
        Matrix,
        MotionConfig,
        RfcConfig,
        RigConfig,
        SensorConfig,
        ServoConfig,
        ServoKind,
        Tangent,
        element,
        rig_struct,
        struct_of,
    )
    from rthyb_rt.core.sizes import (
        DELAY_MAX,
        DENSE_MAX,
        ELEMENTS_MAX,
        FS_HZ,
        IWAN_SLIDERS,
        PERIOD_S,
        WINDOW_MAX,
    )
    from rthyb_rt.core.station import (
        BLIND_MAX,
        CAUSES,
        COMMANDS,
        IDENTITY,
        LOST_TICKS,
        REACTIONS,
        WATCHABLE,
        Calibration,
        Command,
        Parameters,
        Reaction,
        Station,
        StationConfig,
        StationTick,
        Watch,
        command_allowed,
        command_of,
    )
    from rthyb_rt.core.virtual import (
        Virtual,
    )

__all__ = [
    "BLIND_MAX",
    "CAUSES",
    "CHANNELS_MAX",
    "COMMANDS",
    "COMMAND_BIT",
    "DELAY_MAX",
    "DENSE_MAX",
    "ELEMENTS_MAX",
    "ELEMENT_PARAMS",
    "FLAGS",
    "FLAG_NAMES",
    "FS_HZ",
    "IDENTITY",
    "IWAN_SLIDERS",
    "LOST_TICKS",
    "PERIOD_S",
    "REACTIONS",
    "RECORD_DTYPE",
    "RUNNING",
    "STATES",
    "STATUS",
    "WATCHABLE",
    "WINDOW_MAX",
    "Calibration",
    "Channel",
    "Command",
    "Controller",
    "ControllerConfig",
    "CoreError",
    "DenseConfig",
    "DenseIntegrator",
    "Divisor",
    "Element",
    "ElementConfig",
    "Estimator",
    "EstimatorConfig",
    "EstimatorLaw",
    "ExtraSensorConfig",
    "FloatArray",
    "Hold",
    "Integrator",
    "Law",
    "LawConfig",
    "LoadCell",
    "Matrix",
    "Motion",
    "MotionConfig",
    "Parameters",
    "Plc",
    "Reaction",
    "RecordArray",
    "Rfc",
    "RfcConfig",
    "Rig",
    "RigConfig",
    "Sample",
    "SensorConfig",
    "ServoConfig",
    "ServoKind",
    "Station",
    "StationConfig",
    "StationTick",
    "Tangent",
    "Virtual",
    "Watch",
    "as_records",
    "build_facts",
    "check_channels",
    "command_allowed",
    "command_of",
    "dtype_of",
    "element",
    "element_array",
    "finite_motion",
    "plc_is_stable",
    "rig_struct",
    "row_dtype",
    "rows_of",
    "status_names",
    "struct_of",
    "version",
]

_MODULES = ("sizes", "library", "rows", "settings", "kernels", "controller", "station", "virtual")


def __getattr__(name: str) -> Any:
    """Return what a module of the package calls so, which is loaded when it is first asked for.

    A configuration is read without arrays: it needs `laws` and nothing else of the core.
    """
    if name in __all__:
        for module in _MODULES:
            found = import_module(f"{__name__}.{module}")
            if hasattr(found, name):
                globals()[name] = getattr(found, name)
                return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
