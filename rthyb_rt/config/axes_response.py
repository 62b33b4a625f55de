"""The matrix of frequency responses in a rig file with several axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config import response
from rthyb_rt.config.axesfile import AxesRig, JointIdentified
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.config.rate import Rate


def held_otherwise(rig: AxesRig, f_hz: NDArray[np.float64], rate: Rate) -> NDArray[np.complex128]:
    """Return the factors that convert the responses of a rig file to a rate, (n, 1, axes).

    Args:
        rig: the rig; its drives hold their commands, or interpolate.
        f_hz: frequencies, (n,).
        rate: rate of the commands.
    """
    columns = [
        response.held_otherwise(f_hz, rate, response.hold_of(rig.of_axis(name)))
        for name in rig.names
    ]
    return np.stack(columns, axis=-1)[:, None, :]


def response_of_rig(rig: AxesRig, found: JointIdentified, rate: Rate) -> MatrixResponse:
    """Return the responses as numbers, at the rate of a controller.

    Raises:
        InputError: the frequencies do not increase.
    """
    f_hz = np.array(found.frequency_hz)
    swept = np.array(found.real) + 1j * np.array(found.imaginary)
    return MatrixResponse(
        f_hz, swept * held_otherwise(rig, f_hz, rate), np.array(found.rest_noise_displacement_m)
    )
