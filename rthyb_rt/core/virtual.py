"""A test in virtual time: station and virtual rig in one call, without clock and wire."""

from __future__ import annotations

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.core.group import plant_of
from rthyb_rt.core.kernels import VirtualRig
from rthyb_rt.core.library import (
    CoreError,
    FloatArray,
    RecordArray,
    reading,
    writing,
)
from rthyb_rt.core.pending import during, raise_pending
from rthyb_rt.core.rows import CHANNELS_MAX, records_pointer
from rthyb_rt.core.sizes import DENSE_MAX
from rthyb_rt.core.station import COMMANDS, Command, Station


class Virtual:
    """A test in virtual time: a station and a virtual rig, without clock and wire.

    Args:
        station: states, limits, controller, ground motion.
        rig: the virtual rig; its drives share the station's zero.
        stop_decel_m_per_s2: deceleration of a drive's own stop after a trip.
        truth: the first channels are the sensors' inputs without their errors: m and N of each axis
            in turn.
        freedoms: number of channels, after those, with displacements of the numerical part's
            degrees of freedom, m.

    Raises:
        CoreError: the deceleration is not positive, there are more degrees of freedom than a part
            can have, or station and rig differ in rate or number of axes.
    """

    def __init__(
        self,
        station: Station,
        rig: VirtualRig | CoupledRig,
        stop_decel_m_per_s2: float = 1.0,
        truth: bool = False,
        freedoms: int = 0,
    ) -> None:
        self.station, self.rig = station, rig
        self._c = ffi.new("rthyb_virtual *")
        self._ag = reading(station._ag)
        self._c.station, self._c.plant = station._c, plant_of(rig)[0]
        self._c.ag_mps2, self._c.ag_count = self._ag, station._ag.size
        self._c.stop_decel_m_per_s2, self._c.truth = stop_decel_m_per_s2, truth
        self._c.freedoms = freedoms
        error = lib.rthyb_virtual_init(self._c)
        if error == lib.RTHYB_E_PERIOD:
            raise CoreError(
                f"the station ticks every {station._c.cfg.controller.period_s:g} s, but the "
                f"virtual rig every {lib.rthyb_plant_period_s(plant_of(rig)):g} s; the two must "
                "be equal"
            )
        if error == lib.RTHYB_E_PLANT:
            raise CoreError(
                f"the station has {station.config.controller.axis_count} axes, but the virtual "
                f"rig has {lib.rthyb_plant_axes(plant_of(rig))}; the two must be equal, and so "
                "must the numbers of their sensors without an actuator"
            )
        if error:
            raise CoreError(
                f"found a drive that brakes with {stop_decel_m_per_s2} m/s^2, and {freedoms} "
                "degrees of freedom to report; the deceleration must be above 0, and 0 to "
                f"{DENSE_MAX} degrees of freedom can be reported"
            )

    def run(
        self, records: RecordArray, command: Command = "none", channels: FloatArray | None = None
    ) -> int:
        """Fill ``records``, one per tick; the operator's command applies to the first tick.

        Args:
            records: output, with the station's axes, (n,).
            command: command for the first tick.
            channels: output; its columns receive the first channels of each row, (n, count).

        Returns:
            Number of records written; fewer than n if the state changed or a tare failed.

        Raises:
            CoreError: ``channels`` differs from ``records`` in length, or has too many columns.
            OwnCodeError: user code raised an exception.
        """
        number, values, count = COMMANDS.index(command), ffi.NULL, 0
        if channels is not None:
            count = channels.shape[1]
            if len(channels) != records.size or count > CHANNELS_MAX:
                raise CoreError(
                    f"found channels of shape {channels.shape} for {records.size} records; there "
                    f"must be one row for each record and at most {CHANNELS_MAX} columns"
                )
            values = writing(channels)
        rows = records_pointer(records, self.station.config.controller.axis_count)
        with during(self._moment):
            done = lib.rthyb_virtual_run(self._c, number, records.size, rows, values, count)
        raise_pending()
        return int(done)

    def _moment(self) -> str:
        """Return where the test is, in words."""
        station = self.station
        if station.state != "RUNNING":
            return f"in state {station.state}, tick {station.ticks}"
        tick = station.test_tick
        return f"at tick {tick} of the test ({tick * station.config.controller.period_s:.3f} s)"
