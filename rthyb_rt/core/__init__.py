"""Python interface of the C core: ndarrays and dataclasses in, ndarrays out.

Only this package uses cffi. SI units throughout. The names that most of the program needs are
collected here; ticker, loop, ring, wire, signal tables and the numerical parts are modules of their
own.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rthyb_rt.core.controller import (
        Controller,
        Sample,
    )
    from rthyb_rt.core.group import (
        AXIS_WATCHES,
        CAUSES,
        INTERFACE_WATCHES,
        REACTIONS,
        WATCHABLE,
        AxisConfig,
        InterfaceConfig,
        Reaction,
        Watch,
        axis_channels,
        names_of,
    )
    from rthyb_rt.core.kernels import (
        CoreElement,
        Estimator,
        Law,
        Motion,
        Plc,
        Rfc,
        VirtualRig,
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
        STOPPED_BIT,
        UNSENT_BIT,
        Channel,
        as_records,
        axes_in,
        check_channels,
        dtype_of,
        placed_cause,
        record_dtype,
        row_dtype,
        rows_of,
    )
    from rthyb_rt.core.settings import (
        ELEMENT_ABSENT,
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
        STANDARD_RATE_HZ,
        WINDOW_MAX,
    )
    from rthyb_rt.core.station import (
        BLIND_MAX,
        COMMANDS,
        IDENTITY,
        LOST_TICKS,
        AxisParameters,
        AxisReading,
        Command,
        Parameters,
        Station,
        StationConfig,
        StationTick,
        WireCalibration,
        command_allowed,
        command_of,
    )
    from rthyb_rt.core.virtual import (
        Virtual,
    )

__all__ = [
    "AXIS_WATCHES",
    "BLIND_MAX",
    "CAUSES",
    "CHANNELS_MAX",
    "COMMANDS",
    "COMMAND_BIT",
    "DELAY_MAX",
    "DENSE_MAX",
    "ELEMENTS_MAX",
    "ELEMENT_ABSENT",
    "ELEMENT_PARAMS",
    "FLAGS",
    "FLAG_NAMES",
    "FS_HZ",
    "IDENTITY",
    "INTERFACE_WATCHES",
    "IWAN_SLIDERS",
    "LOST_TICKS",
    "PERIOD_S",
    "REACTIONS",
    "RECORD_DTYPE",
    "RUNNING",
    "STANDARD_RATE_HZ",
    "STATES",
    "STATUS",
    "STOPPED_BIT",
    "UNSENT_BIT",
    "WATCHABLE",
    "WINDOW_MAX",
    "AxisConfig",
    "AxisParameters",
    "AxisReading",
    "Channel",
    "Command",
    "Controller",
    "ControllerConfig",
    "CoreElement",
    "CoreError",
    "DenseConfig",
    "DenseIntegrator",
    "Divisor",
    "ElementConfig",
    "Estimator",
    "EstimatorConfig",
    "EstimatorLaw",
    "ExtraSensorConfig",
    "FloatArray",
    "Hold",
    "Integrator",
    "InterfaceConfig",
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
    "VirtualRig",
    "Watch",
    "WireCalibration",
    "as_records",
    "axes_in",
    "axis_channels",
    "build_facts",
    "check_channels",
    "command_allowed",
    "command_of",
    "dtype_of",
    "element",
    "element_array",
    "finite_motion",
    "names_of",
    "placed_cause",
    "plc_is_stable",
    "record_dtype",
    "rig_struct",
    "row_dtype",
    "rows_of",
    "status_names",
    "struct_of",
    "version",
]

_MODULES = (
    "sizes",
    "library",
    "rows",
    "settings",
    "group",
    "kernels",
    "controller",
    "station",
    "virtual",
)


def __getattr__(name: str) -> Any:
    """Return a public name of one of the modules, which is imported on first use.

    Reading a configuration then needs only `laws`, without NumPy.
    """
    if name in __all__:
        for module in _MODULES:
            found = import_module(f"{__name__}.{module}")
            if hasattr(found, name):
                globals()[name] = getattr(found, name)
                return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
