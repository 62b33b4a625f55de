"""The controller without states and limits: one sample, or a run at a virtual rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.group import controller_mapping
from rthyb_rt.core.kernels import VirtualRig
from rthyb_rt.core.library import CoreError, FloatArray, RecordArray, check, doubles, reading
from rthyb_rt.core.pending import raise_pending
from rthyb_rt.core.rows import record_dtype, records_pointer
from rthyb_rt.core.settings import ControllerConfig, fill_part, new_struct


@dataclass(frozen=True)
class Sample:
    """Result of one call of :meth:`Controller.step`."""

    x_cmd_next_m: float
    status: int
    record: dict[str, float | int] = field(repr=False)


class Controller:
    """The controller without states and limits: one sample, or a run at a virtual rig.

    Raises ``CoreError``.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self.config = config
        self._c = ffi.new("rthyb_controller *")
        struct = new_struct("rthyb_controller_config", controller_mapping(config), config)
        self._dtype = record_dtype(config.axis_count)
        self._part = fill_part(struct.numerical, config.numerical)
        check(lib.rthyb_controller_init(self._c, struct))
        self._input = ffi.new("rthyb_input *")
        self._record = ffi.new("rthyb_record *")

    def step(
        self, x_meas_m: float, f_meas_n: float, excitation: float, lost: bool = False
    ) -> Sample:
        """Run one tick; ``excitation`` is ag in m/s^2, or the next command when prescribed."""
        return self.step_axes([(x_meas_m, f_meas_n)], excitation, lost)

    def step_axes(
        self, pairs: Sequence[tuple[float, float]], excitation: float, lost: bool = False
    ) -> Sample:
        """Run one tick with displacement and force of every axis; ``lost`` applies to all axes.

        Raises:
            CoreError: the number of pairs is not that of the axes.
        """
        i, lost_bits = self._input, lib.RTHYB_LOST if lost else 0
        if len(pairs) != self.config.axis_count:
            raise CoreError(
                f"found {len(pairs)} pairs of displacement and force; there must be one for each "
                f"of the {self.config.axis_count} axes"
            )
        i.excitation = excitation
        for k, (x_m, f_n) in enumerate(pairs):
            i.axis[k] = (x_m, f_n, lost_bits)
        code = lib.rthyb_controller_step(self._c, i, self._record)
        raise_pending()
        raw = bytes(ffi.buffer(self._record))[: self._dtype.itemsize]
        row = np.frombuffer(raw, self._dtype)[0]
        return Sample(
            self._c.axis[0].x_cmd,
            code,
            {name: row[name].item() for name in self._dtype.names or ()},
        )

    @property
    def x_cmd_m(self) -> float:
        """Compensated command for the next sample."""
        return float(self._c.axis[0].x_cmd)

    @property
    def commands_m(self) -> tuple[float, ...]:
        """Compensated command of every axis for the next sample."""
        return tuple(self._c.axis[k].x_cmd for k in range(self.config.axis_count))

    @property
    def tick(self) -> int:
        """Index of the next sample."""
        return int(self._c.tick)

    def run_virtual(
        self, rig: VirtualRig, excitation: FloatArray, records: RecordArray
    ) -> tuple[int, int]:
        """Fill ``records`` with the next ticks against ``rig``.

        ``excitation`` covers the whole test, (n_total,). Returns how many records were written
        (fewer when a value was not finite) and the status bits seen.
        """
        if self.config.axis_count != 1:
            raise CoreError(
                "a controller with several axes cannot run on a virtual rig with one axis"
            )
        ag = doubles(excitation)
        status = ffi.new("int32_t *")
        done = lib.rthyb_run_virtual(
            self._c, rig._c, reading(ag), ag.size, records.size, records_pointer(records), status
        )
        raise_pending()
        return int(done), int(status[0])
