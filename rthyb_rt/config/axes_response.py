"""The matrix of frequency responses that a rig file of several axes holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config import response
from rthyb_rt.config.axesfile import AxesRig, JointIdentified
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.config.rate import Rate


def held_otherwise(rig: AxesRig, f_hz: NDArray[np.float64], rate: Rate) -> NDArray[np.complex128]:
    """Return what a rate makes of the responses that a rig file has, as factors, (n, 1, axes).

    Args:
        rig: whose drives hold their commands, or interpolate.
        f_hz: frequencies, (n,).
        rate: of the commands.
    """
    columns = [
        response.held_otherwise(f_hz, rate, response.hold_of(rig.of_axis(name)))
        for name in rig.names
    ]
    return np.stack(columns, axis=-1)[:, None, :]


def response_of_rig(rig: AxesRig, found: JointIdentified, rate: Rate) -> MatrixResponse:
    """Return it as numbers, as a controller of a rate meets it.

    Raises:
        InputError: frequencies that do not rise.
    """
    f_hz = np.array(found.frequency_hz)
    swept = np.array(found.real) + 1j * np.array(found.imaginary)
    return MatrixResponse(
        f_hz, swept * held_otherwise(rig, f_hz, rate), np.array(found.rest_noise_displacement_m)
    )
