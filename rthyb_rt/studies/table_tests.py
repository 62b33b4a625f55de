"""Section 5: hybrid tests of a portal frame on a shaking table, Fig. 5.4 to 5.7."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rthyb_rt import config, core
from rthyb_rt.analysis.summary import stiffness_shares
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.studies.results import Colour, Curve, Floats, Panel, Study, StudyRow, grouped, rms

RIG = "shaking-table-portal-frame"
WINDOWS = (0.2, 0.1, 0.05)
"""Ratios of T0 dt to T: the three windows of the paper."""

NOISE_M, NOISE_N = 10e-6, 20.0
SEEDS = range(5)

CALM = {
    "rig.sensors.displacement.noise_std_m": "2e-6",
    "rig.identified.rest_noise_displacement_m": "2e-6",
}
LOUD = {
    "rig.sensors.displacement.noise_std_m": str(NOISE_M),
    "rig.sensors.force.noise_std_n": str(NOISE_N),
    "rig.identified.rest_noise_displacement_m": str(NOISE_M),
    "rig.identified.rest_noise_force_n": str(NOISE_N),
}


@dataclass(frozen=True)
class TableStructure:
    """One of the two structures of Table 5.1, with the paper's statements and expected values."""

    period_s: float
    mass_kg: float
    damping_n_s_per_m: float
    pga_g: float
    worst_mm: float
    paper_mm: str
    paper_none: str
    none_ends_s: float


STRUCTURES = (
    TableStructure(
        0.5, 4220.0, 2121.0, 0.04, 0.25,
        "all close to the exact solution", "the only one that is not close", 3.1,
    ),
    TableStructure(1.0, 16880.0, 4242.0, 0.02, 0.20, "less than 0.8 mm", "", 10.4),
)  # fmt: skip


def setup(structure: TableStructure, changes: dict[str, str]) -> experiment.Setup:
    """Return the hybrid test of one structure: the built-in test with changes as for ``--set``.

    Raises:
        InputError: a change is invalid.
    """
    base = {
        "test.name": f"section5-t{structure.period_s:g}",
        "numerical.mass_kg": str(structure.mass_kg),
        "numerical.damping_n_s_per_m": str(structure.damping_n_s_per_m),
        "ground_motion.pga_g": str(structure.pga_g),
    }
    settings = [f"{key}={value}" for key, value in {**base, **CALM, **changes}.items()]
    for_test, for_rig = config.split_overrides(settings)
    test = config.load_test(config.builtin_test_path(), for_test)
    rig = config.load_rig(config.shipped_rig(RIG), for_rig)
    return experiment.prepare(test, rig)


@dataclass(frozen=True)
class CompletedTest:
    """A completed test with both benchmarks."""

    setup: experiment.Setup
    rec: RecordedTest
    calibrated: Floats
    naive: Floats

    @property
    def rows(self) -> core.RecordArray:
        """Rows of the test proper, (n,)."""
        return self.rec.samples[self.rec.running()]

    @property
    def x_meas(self) -> Floats:
        """Measured displacement, m."""
        x: Floats = self.rows["x_meas_m"]
        return x

    @property
    def completed(self) -> bool:
        """Whether no limit ended the test."""
        return bool(self.rec.meta["end_reason"] == "completed")

    def response(self, reference: Floats) -> float:
        """Return the response NRMSE against a benchmark, per cent."""
        x_ref = reference[: self.x_meas.size]
        return 100 * rms(self.x_meas - x_ref) / rms(x_ref)

    def tracking(self) -> float:
        """Return the tracking NRMSE, per cent."""
        x_num = self.rows["x_num_m"]
        return 100 * rms(self.x_meas - x_num) / rms(x_num)

    def largest_mm(self) -> float:
        """Return the largest difference from the calibrated benchmark, mm."""
        return 1e3 * float(np.abs(self.x_meas - self.calibrated[: self.x_meas.size]).max())


def perform(structure: TableStructure, changes: dict[str, str]) -> CompletedTest:
    """Run one test and simulate both benchmarks."""
    prepared = setup(structure, changes)
    return CompletedTest(
        prepared,
        virtual_time.run(prepared),
        experiment.reference(prepared, table_forces=True)["x_ref_m"],
        experiment.reference(prepared, table_forces=False)["x_ref_m"],
    )


def cases() -> dict[str, dict[str, str]]:
    """Return the tests of Section 5 by name, as changes of the built-in test."""
    fixed = {"controller.delay_estimator.enabled": "false"}
    named = {
        "PI only": {"controller.type": "none"},
        "PLC α = 17": {**fixed, "controller.rfc.enabled": "false"},
        "PLC + RFC α = 17": fixed,
        "adaptive PLC": {"controller.rfc.enabled": "false"},
    }
    for window in WINDOWS:
        named[f"adaptive PLC + RFC, T0Δt = {window:g} T"] = {
            "controller.rfc.window_periods": str(window)
        }
    return named


def study() -> Study:
    """Reproduce Section 5 on the virtual rig."""
    rows: list[StudyRow] = []
    panels: list[Panel] = []
    for structure in STRUCTURES:
        outcomes = {name: perform(structure, changes) for name, changes in cases().items()}
        compared = {
            name: perform(structure, {"controller.type": name})
            for name in ("none", "paper", "robust", "alpha-beta")
        }
        rows += _rows(structure, outcomes, compared)
        panels += _panels(structure, outcomes, compared)
    rows += grouped(
        f"T = 0.5 s with 10 µm and 20 N of noise, {len(SEEDS)} seeds: where the printed law fails",
        _loud(),
    )
    return Study(
        "5",
        "Hybrid tests on a shaking table",
        "The first 30 s of the built-in El Centro record, at 0.04 g (T = 0.5 s) and 0.02 g (T = 1 "
        "s), each followed by 10 s of free vibration, on a virtual rig that behaves as the "
        "paper's: PI-controlled servo valve, 45 kg of table, friction and viscous force under the "
        "load cell, 2 µm and 5 N of noise.",
        tuple(rows),
        tuple(panels),
        (
            "“El Centro” exists in several processings whose response at equal PGA differs by up "
            "to a quarter; here it is the 50 Hz table of 31.2 s.",
            "The rig's gains, valve and friction are not stated: the virtual rig is chosen so that "
            "its identified delay is the paper's 17 samples.",
            "The adaptive gain is not stated: 0.03 per mm² per sample. With it the printed law "
            "falls below 16 here, because noise on x_m pulls it towards −1/12 wherever the "
            "structure is nearly still; the controller robust stays within the paper's 16 to 19.",
            "“Differences below 0.8 mm” is taken as the largest difference between measured and "
            "calibrated benchmark displacement.",
        ),
    )


def _rows(
    structure: TableStructure,
    outcomes: dict[str, CompletedTest],
    compared: dict[str, CompletedTest],
) -> list[StudyRow]:
    head = f"T = {structure.period_s:g} s"
    rows: list[StudyRow] = []
    windows = {name: outcome for name, outcome in outcomes.items() if "T0Δt" in name}
    for name, outcome in outcomes.items():
        if name not in windows:
            found = _measures(outcome, structure, banded="RFC" in name)
            rows += grouped(f"{head}: compensation side by side", found, name)
    for name, outcome in windows.items():
        k = outcome.rows["k_t_n_per_m"]
        found = [
            *_measures(outcome, structure, banded=True),
            *_delays(outcome),
            StudyRow("Samples with tangent stiffness 0", 100 * float(np.mean(k == 0.0)), "%",
                paper="zero “when the structural responses are small”"),
        ]  # fmt: skip
        case = name.removeprefix("adaptive PLC + RFC, ")
        three = "adaptive PLC + RFC for three windows of the tangent stiffness"
        rows += grouped(f"{head}: {three}", found, case)
    fixed = outcomes["PLC α = 17"]
    benchmarks = (
        ("plate alone", fixed.naive, 50.0 if structure.period_s == 0.5 else 35.0),
        ("with table inertia, friction and viscous force", fixed.calibrated, None),
    )
    for case, reference, least in benchmarks:
        found = [
            StudyRow("Response NRMSE", fixed.response(reference), "%", least, None,
                "the benchmark considers “the combined effects”"),
        ]  # fmt: skip
        rows += grouped(f"{head}: PLC α = 17, against two benchmarks", found, case)
    for name, outcome in compared.items():
        found = _measures(outcome, structure, banded=True)
        if name != "none":
            found += _delays(outcome)
        rows += grouped(f"{head}: controllers side by side", found, name)
    return rows


def _measures(outcome: CompletedTest, structure: TableStructure, *, banded: bool) -> list[StudyRow]:
    """Return the errors of a test; without compensation, the time at which a limit ended it."""
    if outcome.setup.test.controller.type == "none":
        ended = math.nan if outcome.completed else outcome.x_meas.size / core.FS_HZ
        return [
            StudyRow("Time at which the growing motion reaches a limit", ended, "s",
                structure.none_ends_s - 1.0, structure.none_ends_s + 1.0, structure.paper_none),
        ]  # fmt: skip
    return [
        StudyRow("Largest difference from the reference simulation", outcome.largest_mm(), "mm",
            None, structure.worst_mm if banded else None, structure.paper_mm),
        StudyRow("Response NRMSE", outcome.response(outcome.calibrated), "%"),
        StudyRow("Tracking NRMSE", outcome.tracking(), "%"),
    ]  # fmt: skip


def _delays(outcome: CompletedTest) -> list[StudyRow]:
    alpha = outcome.rows["alpha"]
    paper, stated = "16 to 19", (16.0, 19.0)
    return [
        StudyRow(
            "Smallest delay estimate", float(alpha.min()), "samples", paper=paper, stated=stated
        ),
        StudyRow(
            "Largest delay estimate", float(alpha.max()), "samples", paper=paper, stated=stated
        ),
    ]


def _loud() -> list[StudyRow]:
    """Run T = 0.5 s with 10 um and 20 N of noise, five seeds: where the printed law fails."""
    bands = {"paper": (None, 1.0), "robust": (16.0, 17.4), "alpha-beta": (16.4, 17.3)}
    rows = []
    for name, (low, high) in bands.items():
        alphas, responses, tracking = [], [], []
        for seed in SEEDS:
            changes = {**LOUD, "controller.type": name, "rig.rig.seed": str(seed)}
            outcome = perform(STRUCTURES[0], changes)
            alphas.append(float(outcome.rows["alpha"][-1]))
            responses.append(outcome.response(outcome.calibrated))
            tracking.append(outcome.tracking())
        worst = None if name == "paper" else 3.0
        rows += [
            StudyRow(
                "Smallest delay estimate at the end", min(alphas), "samples", low, high, case=name
            ),
            StudyRow(
                "Largest delay estimate at the end", max(alphas), "samples", low, high, case=name
            ),
            StudyRow("Largest response NRMSE", max(responses), "%", None, worst, case=name),
            StudyRow("Largest tracking NRMSE", max(tracking), "%", case=name),
        ]
    return rows


def _panels(
    structure: TableStructure,
    outcomes: dict[str, CompletedTest],
    compared: dict[str, CompletedTest],
) -> list[Panel]:
    key = f"t{structure.period_s:g}".replace(".", "-")
    figure = "5.4" if structure.period_s == 0.5 else "5.5"
    head = f"T = {structure.period_s:g} s"
    reference = outcomes["adaptive PLC"]
    t = np.arange(reference.setup.ticks) / core.FS_HZ
    colours: tuple[Colour, ...] = ("orange", "blue", "green")
    windows = [f"adaptive PLC + RFC, T0Δt = {w:g} T" for w in WINDOWS]
    tested = [
        replace(_curve(f"T0Δt = {w:g} T", t, outcomes[name], "x_meas_m", 1e3), colour=colour)
        for w, name, colour in zip(WINDOWS, windows, colours, strict=True)
    ]
    delays: dict[str, Any] = {
        "y_range": (12, 21), "levels": ((16.0, "paper: 16"), (19.0, "paper: 19")), "half": True,
    }  # fmt: skip
    none = _curve("PI only", t, outcomes["PI only"], "x_meas_m", 1e3)
    peak = 1.3e3 * float(np.abs(reference.calibrated).max())
    return [
        Panel(
            f"fig-{figure}", f"Test and benchmark, {head} (Fig. {figure})", "time, s",
            "displacement, mm",
            (
                *tested,
                replace(none, colour="red"),
                Curve("benchmark", t, reference.calibrated * 1e3, "black", width=0.6),
            ),
            "PI only exceeds the range shown and is ended by a limit.", y_range=(-peak, peak),
        ),
        Panel(
            f"fig-{key}-difference", f"Difference from the benchmark, {head}", "time, s",
            "x_m − benchmark, mm",
            tuple(
                replace(curve, y=curve.y - 1e3 * reference.calibrated[: curve.y.size])
                for curve in tested
            ),
        ),
        Panel(
            f"fig-{key}-naive", f"What the benchmark must contain, {head}", "time, s",
            "displacement, mm",
            (
                Curve("plate alone", t, reference.naive * 1e3, "red"),
                replace(_curve("test", t, reference, "x_meas_m", 1e3), width=1.6),
                Curve("with table inertia and friction", t, reference.calibrated * 1e3, "black",
                      width=0.6),
            ),
        ),
        Panel(
            f"fig-5-6-{key}", f"Delay estimate, {head} (Fig. 5.6)", "time, s", "α, samples",
            tuple(
                replace(_curve(f"T0Δt = {w:g} T", t, outcomes[name], "alpha", 1.0), colour=colour)
                for w, name, colour in zip(WINDOWS, windows, colours, strict=True)
            ),
            "Controller paper. The window has hardly any effect: the curves coincide.", **delays,
        ),
        Panel(
            f"controllers-{key}", f"Delay estimate by controller, {head}", "time, s", "α, samples",
            tuple(
                replace(_curve(name, t, compared[name], "alpha", 1.0), colour=colour)
                for name, colour in zip(("paper", "robust", "alpha-beta"), colours, strict=True)
            ),
            **delays,
        ),
        Panel(
            f"fig-5-7-{key}", f"Tangent stiffness, {head} (Fig. 5.7)", "time, s",
            "samples of k_exp, %",
            _shares(outcomes[windows[1]]),
            "T0Δt = 0.1 T; share of the samples in each second.", y_range=(0, 100), half=True,
        ),
        Panel(
            f"fig-5-7-{key}-peak", f"The same at the peak, {head}", "time, s", "k_exp, kN/m",
            (_curve("", t, outcomes[windows[1]], "k_t_n_per_m", 1e-3),),
            "Bounded by 0 and the elastic stiffness.", y_range=(-30, 760), half=True,
            x_range=_at_peak(structure, t, reference.calibrated),
            levels=((666.4, "k_e"),),
        ),
    ]  # fmt: skip


def _at_peak(structure: TableStructure, t: Floats, x: Floats) -> tuple[float, float]:
    """Return one and a half periods around the peak, s."""
    centre = float(t[np.argmax(np.abs(x))])
    return centre - 0.75 * structure.period_s, centre + 0.75 * structure.period_s


def _shares(outcome: CompletedTest) -> tuple[Curve, ...]:
    """Return the fractions of the tangent stiffness at its bounds as stacked areas."""
    k_t = outcome.rows["k_t_n_per_m"]
    edges, shares = stiffness_shares(k_t, outcome.setup.derived.k_e_n_per_m, core.FS_HZ)
    x = np.repeat(edges, 2)[1:-1]
    levels = 100.0 * np.vstack([np.zeros(shares.shape[1]), np.cumsum(shares, axis=0)])
    colours: tuple[Colour, ...] = ("red", "blue", "grey")
    return tuple(
        Curve(
            label, np.concatenate([x, x[::-1]]),
            np.concatenate([np.repeat(low, 2), np.repeat(high, 2)[::-1]]), colour, width=0.0,
            filled=True,
        )
        for label, colour, low, high in zip(
            ("at 0", "between", "at k_e"), colours, levels[:-1], levels[1:], strict=True
        )
    )  # fmt: skip


def _curve(label: str, t: Floats, outcome: CompletedTest, field: str, factor: float) -> Curve:
    values = outcome.rows[field]
    return Curve(label, t[: values.size], values * factor)
