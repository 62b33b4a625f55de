"""After how many equal readings in a row zeroing knows that a sensor is frozen.

Noise makes readings differ, if it is large enough compared with their step. Sensors of which this
is not known are zeroed with whatever they read.
"""

from __future__ import annotations

from rthyb_rt.config import RigFile, defaults
from rthyb_rt.config.linkframes import codec_of_link
from rthyb_rt.config.lonesensors import LoneForce, LoneSensor
from rthyb_rt.config.rate import Rate
from rthyb_rt.lab import axis_wires


def of_axis(rig: RigFile, tare_ticks: int, rate: Rate) -> tuple[int, int]:
    """Return the numbers for displacement sensor and load cell of an axis; 0: not known.

    Args:
        rig: the axis, as a rig of one axis.
        tare_ticks: readings of the tare.
        rate: rate of the test.

    Raises:
        InputError: the DBC file of its link cannot be read or used.
    """
    displacement, force, found = rig.sensors.displacement, rig.sensors.force, rig.identified
    noise_m, noise_n = displacement.noise_std_m, force.noise_std_n
    # What identification has measured is the noise of a real sensor, but not of a simulated one.
    if rig.link is not None and not rig.link.virtual and found is not None:
        noise_m, noise_n = (
            stated if measured is None else measured
            for stated, measured in (
                (noise_m, found.rest_noise_displacement_m),
                (noise_n, found.rest_noise_force_n),
            )
        )
    codec, by = codec_of_link(rig.link), axis_wires.calibration(rig)
    step_m = max(displacement.lsb_m, codec.reading_step(force=False, gain=by.x_gain))
    step_n = max(force.lsb_n, codec.reading_step(force=True, gain=by.f_gain))
    return (
        defaults.frozen_ticks(noise_m, step_m, tare_ticks, rate),
        defaults.frozen_ticks(noise_n, step_n, tare_ticks, rate),
    )


def of_sensor(one: LoneSensor, step: float, tare_ticks: int, rate: Rate) -> int:
    """Return the number for a sensor without an actuator; 0: not known.

    Args:
        one: the sensor.
        step: difference of neighbouring readings in its frames, m or N.
        tare_ticks, rate: as for `of_axis`.
    """
    noise, lsb = (
        (one.noise_std_n, one.lsb_n) if isinstance(one, LoneForce) else (one.noise_std_m, one.lsb_m)
    )
    return defaults.frozen_ticks(noise, max(lsb, step), tare_ticks, rate)
