"""Identification of a virtual rig: the properties that a test needs (`rthyb identify`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic_core import PydanticCustomError

from rthyb_rt import config
from rthyb_rt.api import files
from rthyb_rt.api.files import Place, Rig
from rthyb_rt.api.messages import in_python, require_progress
from rthyb_rt.api.recordings import Plot, Recording, plot_of
from rthyb_rt.config import AxesRig
from rthyb_rt.config.fields import Range
from rthyb_rt.errors import InputError
from rthyb_rt.rig import identification, identify_axes

Progress = Callable[[int, int], None]
"""Called with the number of samples done and the total number."""

_WORDS: Final = {r" \(--amplitude\)": "", r" \(--max-frequency\)": ", max_frequency"}
_AMPLITUDE: Final = Range("m", 1e-5, 1.0, "the amplitude of the slow sines", 'as in "1 mm"')
_FREQUENCY: Final = Range("Hz", 0.05, 100.0, "the last sine's frequency", 'as in "5 Hz"')

_VELOCITY: Final = Range("m/s", 1e-4, 10.0, "the largest velocity of a sine", 'as in "50 mm/s"')


class Identification:
    """Result of an identification.

    Attributes:
        rig: the rig with the identified values filled in, to be used in tests.
    """

    def __init__(self, found: identification.IdentificationResult, rig: Rig) -> None:
        self._found, self.rig = found, rig

    @property
    def measures(self) -> dict[str, Any]:
        """Identified values by name, as in ``rthyb identify --json``: SI units; alpha in samples.

        Names include the unit. A value is None if it could not be determined.
        """
        found = self._found.as_json()
        return {name: value for name, value in found.items() if name not in ("tones", "notes")}

    @property
    def tones(self) -> list[dict[str, float]]:
        """Result for each sine: frequency, gain, delay, force in phase and in quadrature."""
        return [dataclasses.asdict(tone) for tone in self._found.tones]

    @property
    def notes(self) -> list[str]:
        """Remarks for the user."""
        return list(self._found.notes)

    @property
    def recording(self) -> Recording:
        """Recording of the identification."""
        assert self._found.recording is not None
        return Recording(self._found.recording)

    def plot(self) -> Plot:
        """Plot gain, phase and delay over frequency, with the model that `check` uses.

        Raises:
            InputError: matplotlib is not installed.
        """
        from rthyb_rt.report.html import extra_needed

        with extra_needed("a figure"):
            from rthyb_rt.report.bode import bode
        file = files.file_of_rig(self.rig)
        assert not isinstance(file, AxesRig)
        plate = bode(file, self._found.tones)
        return plot_of(plate)

    def __repr__(self) -> str:
        from rthyb_rt.numbers import quantity

        found = self._found
        return (
            f"<Identification {self.rig.name}: delay {quantity(found.delay_s, 'ms', 1e3)}, "
            f"alpha {quantity(found.alpha, 'samples', digits=4)}, "
            f"k_e {quantity(found.k_e_n_per_m, 'kN/m', 1e-3, 4)}>"
        )


class AxesIdentification:
    """Result of the identification of a rig with several axes.

    Attributes:
        rig: the rig with the identified values filled in, for use in tests.
    """

    def __init__(self, found: identify_axes.AxesResult, rig: Rig) -> None:
        self._found, self.rig = found, rig

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes, in the order of the rig file."""
        return self._file.names

    @property
    def measures(self) -> dict[str, Any]:
        """The figures as in ``rthyb identify --json``, SI units.

        ``axes`` has those of each axis by name, as for a rig with one axis while the others are
        held still; ``response`` is the matrix of frequency responses; ``stiffness`` is that of the
        specimen along the directions of the interface, and ``asymmetry`` the largest difference
        between two entries in it that should be equal, relative to the largest entry.
        """
        return self._found.as_json(self._file)

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Frequencies of the sines, Hz, (n,)."""
        return self._found.response.frequency_hz.copy()

    @property
    def response(self) -> NDArray[np.complex128]:
        """Reading of the row's axis over command of the column's, (n, axes, axes)."""
        return self._found.response.response.copy()

    @property
    def stiffness(self) -> NDArray[np.float64]:
        """Stiffness matrix along the directions of the interface, SI units, (axes, axes)."""
        return self._found.stiffness.copy()

    @property
    def notes(self) -> list[str]:
        """Remarks for the user, each with the axis to which it applies."""
        named = zip(self.axis_names, self._found.axes, strict=True)
        return [f"axis {name}: {note}" for name, own in named for note in own.notes]

    @property
    def _file(self) -> AxesRig:
        file = files.file_of_rig(self.rig)
        assert isinstance(file, AxesRig)
        return file

    def __repr__(self) -> str:
        from rthyb_rt.numbers import quantity

        named = zip(self.axis_names, self._found.axes, strict=True)
        delays = ", ".join(f"{name} {quantity(own.delay_s, 'ms', 1e3)}" for name, own in named)
        return f"<AxesIdentification {self.rig.name}: delays {delays}>"


def identify(
    rig: Rig | Place,
    *,
    amplitude: float | str = "2 mm",
    max_frequency: float | str = "10 Hz",
    max_velocity: float | str = "50 mm/s",
    progress: Progress | None = None,
) -> Identification | AxesIdentification:
    """Determine delay, gain, stiffness and noise of a virtual rig with sines of rising frequency.

    With several axes, each is moved in turn while the others are held still. To identify a rig in
    the laboratory, use ``rthyb identify --realtime``.

    Args:
        rig: a rig, or the path or name of one. The file of a rig with one axis does not need an
            elastic stiffness, which is to be found.
        amplitude: amplitude of the slow sines in m, or a string with a unit; 0.01 mm to 1 m.
        max_frequency: frequency of the last sine in Hz, or a string with a unit; 0.05 Hz to 100 Hz.
        max_velocity: largest velocity of a sine in m/s, or a string with a unit; 0.1 mm/s to
            10 m/s. The amplitude of faster ones is reduced, and a note says so.
        progress: called at intervals.

    Returns:
        The result; for a rig with several axes, an `AxesIdentification`.

    Raises:
        InputError: the rig is invalid, or cannot be identified; the message explains why. Or your
            own element raised an exception, which is then the cause of this one; the message names
            its file and line.

    Examples:
        >>> found = identify("delay-10-elastic")
        >>> round(found.measures["alpha"])
        10
    """
    on = files.rig_to_identify(rig)
    require_progress(progress, "identify")
    try:
        sweep = identification.SweepPlan.up_to(
            _read(max_frequency, "max_frequency", _FREQUENCY),
            _read(amplitude, "amplitude", _AMPLITUDE),
            _read(max_velocity, "max_velocity", _VELOCITY),
        )
        return _identified(on, sweep, progress)
    except InputError as error:
        # The cause is an exception that a user's element raised, or there is none.
        raise in_python(error, _WORDS) from error.__cause__


def _identified(
    on: Rig, sweep: identification.SweepPlan, progress: Progress | None
) -> Identification | AxesIdentification:
    file, called = files.file_of_rig(on), f"identified {on.name}"
    if isinstance(file, AxesRig):
        of_all = identify_axes.identify_rig(file, sweep, progress)
        known = identify_axes.identified_rig(file, of_all)
        return AxesIdentification(of_all, Rig.from_toml(config.dump(known), called))
    result = identification.identify(file, sweep, progress)
    filled = identification.identified_rig(file, result)
    return Identification(result, Rig.from_toml(config.dump(filled), called))


def _read(value: float | str, name: str, allowed: Range) -> float:
    try:
        return allowed.read(files.plain(value))
    except PydanticCustomError as error:
        text = str((error.context or {}).get("text", error))
        raise InputError(text, f"identify: {name}") from None
