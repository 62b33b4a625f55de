"""The controller without states and limits: one sample, or a run at a virtual rig."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.kernels import Rig
from rthyb_rt.core.library import FloatArray, RecordArray, check, doubles, reading
from rthyb_rt.core.pending import raise_pending
from rthyb_rt.core.rows import RECORD_DTYPE, records_pointer
from rthyb_rt.core.settings import ControllerConfig, fill_part, struct_of


@dataclass(frozen=True)
class Sample:
    """What one call of :meth:`Controller.step` gives back."""

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
        struct = struct_of("rthyb_controller_config", replace(config, numerical=None))
        self._part = fill_part(struct.numerical, config.numerical)
        check(lib.rthyb_controller_init(self._c, struct))
        self._input = ffi.new("rthyb_input *")
        self._record = ffi.new("rthyb_record *")

    def step(
        self, x_meas_m: float, f_meas_n: float, excitation: float, lost: bool = False
    ) -> Sample:
        """Run one tick; ``excitation`` is ag in m/s^2, or the next command when prescribed."""
        i = self._input
        i.x_meas_m, i.f_meas_n, i.excitation = x_meas_m, f_meas_n, excitation
        i.lost = lib.RTHYB_LOST if lost else 0
        code = lib.rthyb_controller_step(self._c, i, self._record)
        raise_pending()
        row = np.frombuffer(bytes(ffi.buffer(self._record)), RECORD_DTYPE)[0]
        return Sample(
            self._c.x_cmd, code, {name: row[name].item() for name in RECORD_DTYPE.names or ()}
        )

    @property
    def x_cmd_m(self) -> float:
        """Command for the next sample."""
        return float(self._c.x_cmd)

    @property
    def tick(self) -> int:
        """Index of the next sample."""
        return int(self._c.tick)

    def run_virtual(
        self, rig: Rig, excitation: FloatArray, records: RecordArray
    ) -> tuple[int, int]:
        """Fill ``records`` with the next ticks against ``rig``.

        ``excitation`` is the whole test's, (n_total,). Returns how many records were written
        (fewer when a value was not finite) and the status bits seen.
        """
        ag = doubles(excitation)
        status = ffi.new("int32_t *")
        done = lib.rthyb_run_virtual(
            self._c, rig._c, reading(ag), ag.size, records.size, records_pointer(records), status
        )
        raise_pending()
        return int(done), int(status[0])
