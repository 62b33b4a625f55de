"""Repeated simulation of a hybrid test: same test, controller and ground motion, two models.

The diagnosis splits the loop at the recorded signals. Here its result is evaluated with the loop
closed: the model as given and the model with the effects found each replace the rig in virtual
time, and the simulated test is compared with the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rthyb_rt import config, core
from rthyb_rt.core import RUNNING
from rthyb_rt.diagnose.case import NO_READING, Floats, Model
from rthyb_rt.diagnose.drive_clock import made_up
from rthyb_rt.diagnose.predict import nrmse
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import end_reasons, experiment, trips, virtual_time
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.lab.virtual_time import Bench
from rthyb_rt.record.recording import RecordedTest

Law = Callable[[float, float], float]

SIGNALS: dict[str, str] = {
    "x_meas": "x_meas_m",
    "x_num": "x_num_m",
    "f_meas": "f_meas_n",
    "alpha": "alpha",
}
"""The compared signals, and their fields in the record."""


@dataclass(frozen=True)
class ClosedLoop:
    """A recorded test beside its simulation with two models.

    Attributes:
        t: time of the rows of the test proper, (n,), s.
        recorded, before, after: by name of `SIGNALS`, each (n,), m, N or samples; NaN where a
            reading was predicted during the test, and after the end of a simulated test.
        nrmse_before, nrmse_after: by the same names, fractions: rms of the difference over the
            standard deviation of the recording; for alpha, which may be constant, over its rms.
        notes: limits of the comparison.
    """

    t: Floats
    recorded: dict[str, Floats]
    before: dict[str, Floats]
    after: dict[str, Floats]
    nrmse_before: dict[str, float]
    nrmse_after: dict[str, float]
    notes: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the figures for the answer."""
        return {
            "possible": True,
            "nrmse_before": self.nrmse_before,
            "nrmse_after": self.nrmse_after,
            "notes": self.notes,
        }


def resimulate(rec: RecordedTest, given: str, augmented: str, law: Law | None = None) -> ClosedLoop:
    """Simulate a recorded test with the model as given and with the effects found in it.

    Args:
        rec: recording of this program; its test, rig and ground motion determine the controller.
        given, augmented: the two models as text of rig files; only their actuator, specimen and
            sensors are used.
        law: force in addition to the augmented specimen, N, of displacement (m) and velocity (m/s).

    Raises:
        InputError: the recording cannot be repeated, or a rig file is invalid.
    """
    if rec.meta.get("interrupted"):
        raise InputError("the test was held and resumed, so its ground motion is interrupted")
    mask = rec.running()
    count = int(mask.sum())
    setup, settings = _as_recorded(rec, count)
    recorded = _signals(rec.samples[mask])
    notes: list[str] = []
    runs = []
    for name, text, beside in (
        ("the model as given", given, None), ("what was found", augmented, law),
    ):  # fmt: skip
        virtual = experiment.rig_config(config.parse_rig(text, name), rec.fs_hz)
        bench = Bench(setup, virtual, settings) if beside is None else _Beside(
            setup, virtual, settings, beside
        )  # fmt: skip
        virtual_time.conduct(bench)
        samples = bench.rows[bench.rows["state"] == RUNNING]
        if samples.size < count:
            why = trips.figures(*bench.causing) or end_reasons.in_words(bench.causing[0])
            notes.append(
                f"simulated with {name}, the test ends at {samples.size / rec.fs_hz:.2f} s: {why}"
            )
        made = _signals(samples)
        runs.append({k: np.r_[v, np.full(count - v.size, np.nan)] for k, v in made.items()})
    before, after = runs
    return ClosedLoop(
        np.arange(count) / rec.fs_hz, recorded, before, after,
        _errors(before, recorded), _errors(after, recorded), notes,
    )  # fmt: skip


def _as_recorded(rec: RecordedTest, count: int) -> tuple[Setup, core.StationConfig | None]:
    """Return the recorded test with this duration, and its station settings if recorded."""
    test = config.parse_test(rec.test_toml, "recording: test")
    rig = config.parse_rig(rec.rig_toml, "recording: rig")
    derived = config.derive(test, rig)
    ag = np.zeros(count)
    known = rec.ag_mps2[:count]
    ag[: known.size] = known
    moving = np.flatnonzero(rec.ag_mps2)
    end_tick = int(moving[-1]) + 1 if moving.size else count
    setup = Setup(
        test=test,
        rig=rig,
        derived=derived,
        motion=GroundMotion("recorded", "recording", 1.0 / rec.fs_hz, ag),
        ag_mps2=ag,
        controller=experiment.controller_config(test, rig, derived, end_tick),
        virtual_rig=experiment.rig_config(rig, rec.fs_hz),
    )
    first = rec.replay.parameters[0]["values"] if rec.replay.parameters else {}
    stated = core.StationConfig.of(first["station"]) if "station" in first else None
    return setup, stated


class _Beside(Bench):
    """The same with a force computed in Python in addition to the specimen's, sample by sample."""

    def __init__(
        self, setup: Setup, rig: core.RigConfig, settings: core.StationConfig | None, law: Law
    ) -> None:
        super().__init__(setup, rig, settings)
        self._rig, self._law = core.VirtualRig(rig), law
        self._command_m = 0.0
        self._was_m = self._rig.true_displacement_m

    def _fill(self, rows: core.RecordArray, command: core.Command, values: Floats) -> int:
        state = self.state
        for n in range(rows.size):
            x_m, f_n, _ = self._rig.step(self._command_m)
            now_m = self._rig.true_displacement_m
            f_n += self._law(now_m, (now_m - self._was_m) * self.run.setup.derived.fs_hz)
            self._was_m = now_m
            first = self._command_m if self.run.station.ticks == 0 else None
            tick = self.run.station.tick(x_m, f_n, command=command, taken_over_m=first)
            rows[n] = tick.records[-1]
            self._command_m = tick.x_cmd_m if tick.sent else self._command_m
            command = "none"
            if tick.state != state or self.zeroing_failed:
                if (state, tick.state) == ("RAMP_IN", "RUNNING"):
                    self._rig.reseed()  # as the core does
                return n + 1
        return int(rows.size)


def _signals(samples: core.RecordArray) -> dict[str, Floats]:
    out = {name: samples[key].astype(np.float64) for name, key in SIGNALS.items()}
    for values in out.values():
        values[~(np.abs(values) < NO_READING)] = np.nan
    unknown = made_up(samples)
    out["x_meas"][unknown] = out["f_meas"][unknown] = np.nan
    return out


def _errors(made: dict[str, Floats], recorded: dict[str, Floats]) -> dict[str, float]:
    out = {name: nrmse(made[name], recorded[name]) for name in SIGNALS if name != "alpha"}
    good = np.isfinite(made["alpha"]) & np.isfinite(recorded["alpha"])
    size = float(np.sqrt(np.mean(recorded["alpha"][good] ** 2))) if good.any() else 0.0
    gap = (made["alpha"] - recorded["alpha"])[good]
    out["alpha"] = float(np.sqrt(np.mean(gap**2))) / size if size else float("nan")
    return out


def same_actuator(model: Model, rec: RecordedTest) -> Model:
    """Return the model with the recording's own rig where it does not describe one.

    A baseline file has at most a second-order actuator; without one, the rig of the recording is
    used, with a load cell that measures the specimen only.
    """
    if model.rig is not None or model.actuator is not None:
        return model
    rig = config.parse_rig(rec.rig_toml, "recording: rig")
    frame = rig.rig.model_copy(update={"load_cell": "specimen"})
    return replace(model, rig=rig.model_copy(update={"rig": frame}))
