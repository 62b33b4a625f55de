"""A recording of several axes, diagnosed axis by axis, with the measured motion of the others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.case import Model, error_of_zero, tare_rows
from rthyb_rt.diagnose.modelfile import model_of_rig
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig
    from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class OfAxis:
    """One axis of a rig with several, and the laboratory's model of all of them.

    Attributes:
        name: name of the axis.
        rig: the laboratory's rig file.
    """

    name: str
    rig: AxesRig

    @property
    def model(self) -> Model:
        """The axis alone: its actuator, and the specimen as seen by it, with the others at rest.

        The noise of its force includes that of the load cell and, through the stiffness, that of
        the displacement sensors of the other axes.
        """
        from rthyb_rt import config
        from rthyb_rt.record.axis_export import alone, stiffness_of

        own, k = model_of_rig(alone(self.rig, self.name)), self.rig.names.index(self.name)
        felt = np.array(self.rig.along_axes(stiffness_of(self.rig))[k])
        felt[k] = 0.0
        noise_m = [axis.sensors.displacement.noise_std_m or 0.0 for axis in self.rig.axis]
        f_std = float(np.hypot(own.f_std or 0.0, np.linalg.norm(felt * noise_m)))
        notes = tuple(note for note in config.omitted(self.rig) if f"axis {self.name}: " in note)
        return replace(own, f_std=f_std or None, notes=notes)

    def fits(self, names: tuple[str, ...], where: str) -> None:
        """Reject a recording whose axes are not those of the rig.

        Raises:
            InputError: with the names of both.
        """
        if names != self.rig.names:
            found = f"was recorded on the axes {', '.join(names)}" if names else "has only one axis"
            raise InputError(
                f'{found}, but the model "{self.rig.rig.name}" has the axes '
                f"{', '.join(self.rig.names)}; give the rig file of this recording as --model",
                where,
            )

    def signals(self, rec: RecordedTest) -> dict[str, Floats]:
        """Return the channels of the axis in the rows of the test, (n,) each.

        ``f_meas`` is its load cell less the force due to the motion of the others, by this rig.
        """
        from rthyb_rt.record.axis_export import axis_signals

        found = axis_signals(rec, self.name, self.rig)
        del found["t"]
        return found

    def force_of_others(self, rec: RecordedTest) -> Floats:
        """Return the force on the axis due to the motion of the others, N, (rows of the test,)."""
        from rthyb_rt.record.axis_export import force_of_others

        return force_of_others(rec, self.name, self.rig)

    def zero_error_n(self, rec: RecordedTest) -> float:
        """Return the standard error of the zero of ``f_meas``, N; 0: not known.

        The displacements of the other axes were zeroed over the same rows, and their errors
        contribute through the stiffness.
        """
        from rthyb_rt.record.axis_export import from_others

        rows, k = tare_rows(rec), rec.axis_names.index(self.name)
        read = np.column_stack([rec.axis(one)["x_read_m"][rows] for one in rec.axis_names])
        if rows.size < 3 or not np.isfinite(read).all():
            return 0.0
        plain: dict[str, Any] = {"damping": None, "mass": None, "element": []}
        specimen = self.rig.specimen.model_copy(update=plain)
        still = self.rig.model_copy(update={"specimen": specimen})
        others = from_others(still, k, read - read.mean(axis=0), 1.0 / rec.fs_hz)
        return error_of_zero(rec.axis(self.name)["f_read_n"][rows] - others)


def chosen(
    recording: Path, names: tuple[str, ...], model: Path, axis: str | None, asked: str
) -> list[OfAxis]:
    """Return the axes of a recording to diagnose; none for a recording of one axis.

    Args:
        recording: its path, for messages.
        names: names of its axes.
        model: file of the laboratory's model.
        axis: the requested axis; None: all.
        asked: the option or argument that names it, for messages.

    Raises:
        InputError: there is no such axis, or the model is not of these axes.
    """
    if axis is not None and axis not in names:
        raise InputError(
            f"found {axis}; the recording has the axes {', '.join(names)}"
            if names
            else f"found {axis}, but the recording has only one axis; omit the option",
            asked,
        )
    if not names:
        return []
    rig = read_axes_rig(model)
    found = [OfAxis(name, rig) for name in names if axis in (None, name)]
    found[0].fits(names, str(recording))
    return found


def read_axes_rig(path: Path) -> AxesRig:
    """Read the model of a recording of several axes: a rig file, or a test file that names one.

    Raises:
        InputError: with all errors in the file, or it has one axis only.
    """
    from rthyb_rt import config

    text = config.read_text(path, "model")
    schema = str(config.schema_of(text, str(path)))
    rig = None
    if schema.startswith("rthyb-test/"):
        rig = config.load_any_rig(config.find_rig(config.load_test(path).rig))
    elif schema.startswith("rthyb-rig/"):
        rig = config.load_any_rig(path)
    if not isinstance(rig, config.AxesRig):
        raise InputError(
            "is a model of one axis, but the recording has several; give the rig file with all "
            "axes, such as the rig.toml in the folder of the run",
            str(path),
        )
    return rig
