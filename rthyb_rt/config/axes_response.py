"""The matrix of frequency responses that a rig file of several axes holds."""

from __future__ import annotations

import numpy as np

from rthyb_rt.config.axesfile import JointIdentified
from rthyb_rt.config.matrix_response import MatrixResponse


def response_of_rig(found: JointIdentified) -> MatrixResponse:
    """Return it as numbers; raises ``InputError`` for frequencies that do not rise."""
    return MatrixResponse(
        np.array(found.frequency_hz),
        np.array(found.real) + 1j * np.array(found.imaginary),
        np.array(found.rest_noise_displacement_m),
    )
