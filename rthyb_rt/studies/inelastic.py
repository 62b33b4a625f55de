"""Section 4.2: hybrid test of a yielding structure behind a ten-sample delay, Fig. 4.3 to 4.5."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib import util
from pathlib import Path

import numpy as np

from rthyb_rt import core, ground_motion
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.studies.results import Curve, Floats, Panel, Study, StudyRow, grouped, rms

MASS_KG, DAMPING_N_S_PER_M, K_N_PER_M = 30000.0, 15080.0, 4737410.0
PERIOD_S = 0.5
MOTION_S, FREE_S = 50.0, 10.0
PGA_G = 0.2
WINDOW = 51
DELAY = 10
GAIN = 0.005

BOUC_WEN = core.element(
    "hysteresis", k_n_per_m=K_N_PER_M, post_yield_ratio=0.02, a=1.0, b=300.0, c=200.0, eta=1.5
)
ELASTIC = core.element("stiffness", k_n_per_m=K_N_PER_M)


def tcu068(record: str | Path | None = None) -> GroundMotion | None:
    """Return the first 50 s of Chi-Chi TCU068 EW, or None if it is not available.

    The record must not be redistributed: it is taken from ``record`` or from the package pyslammer.

    Raises:
        InputError: ``record`` cannot be read.
    """
    if record is None:
        package = util.find_spec("pyslammer")
        if package is None or package.origin is None:
            return None
        folder = Path(package.origin).parent / "sample_ground_motions"
        record = folder / "Chi-Chi_1999_TCU068-090.csv"
        if not record.is_file():
            return None
    return ground_motion.read(record).window(0.0, MOTION_S)


def excitation(motion: GroundMotion) -> Floats:
    """Return the motion at 0.2 g, followed by rest, at 1024 Hz, m/s^2; interpolated linearly."""
    return ground_motion.resample(
        motion.scaled(pga_g=PGA_G), core.FS_HZ, method="linear", duration_s=MOTION_S + FREE_S
    )


def motion_config(integrator: core.Integrator) -> core.MotionConfig:
    """Return the structure of Section 4.2."""
    return core.MotionConfig(
        integrator,
        mass_kg=MASS_KG,
        damping_n_s_per_m=DAMPING_N_S_PER_M,
        k_e_n_per_m=K_N_PER_M,
    )


@dataclass(frozen=True)
class InelasticCase:
    """A way of running the test; ``law`` None: the command is not compensated."""

    law: core.LawConfig | None
    rfc: bool = False
    tangent: core.Tangent = "mean-of-ratios"
    integrator: core.Integrator = "forward-euler"
    specimen: core.ElementConfig = BOUC_WEN
    delay: int = DELAY
    noise_std_m: float = 0.0
    noise_std_n: float = 0.0


def adaptive(gain: float = GAIN, alpha0: float = 0.0) -> core.LawConfig:
    """Return the paper's law, starting at alpha = ``alpha0``."""
    key = "delay_estimator.gain_per_mm2_per_sample"
    return core.LawConfig("paper", {"alpha0": alpha0, key: gain})


def fixed(alpha: float) -> core.LawConfig:
    """Return the paper's phase lead for a fixed delay."""
    return core.LawConfig("paper", {"alpha0": alpha}, adapts=False)


def simulate(case: InelasticCase, ag: Floats) -> core.RecordArray:
    """Return the records of the hybrid test."""
    controller = core.Controller(
        core.ControllerConfig(
            law=case.law or core.LawConfig(),
            rfc=core.RfcConfig(
                k_e_n_per_m=K_N_PER_M,
                enabled=case.rfc,
                tangent=case.tangent,
                window=WINDOW,
                end_tick=round(MOTION_S * core.FS_HZ),
                rest_noise_m=case.noise_std_m,
            ),
            motion=motion_config(case.integrator),
            lead_enabled=case.law is not None,
        )
    )
    rig = core.VirtualRig(
        core.RigConfig(
            core.ServoConfig("pure-delay", delay_samples=case.delay),
            (case.specimen,),
            displacement=core.SensorConfig(noise_std=case.noise_std_m),
            force=core.SensorConfig(noise_std=case.noise_std_n),
        )
    )
    records = np.zeros(ag.size, dtype=core.RECORD_DTYPE)
    done, _ = controller.run_virtual(rig, ag, records)
    return records[:done]


def exact(ag: Floats, integrator: core.Integrator = "forward-euler") -> tuple[Floats, Floats]:
    """Return displacement and force without delay: the paper's "exact" solution."""
    x, _, force = core.Motion(motion_config(integrator)).reference([BOUC_WEN], ag)
    return x, force


def free_decay_ratio(integrator: core.Integrator) -> float:
    """Return the damping ratio of the elastic structure's free vibration by log decrement."""
    ag = np.zeros(round(20 * core.FS_HZ))
    motion = core.Motion(motion_config(integrator), 0.0)
    ag[0] = 1.0  # an impulse of one sample
    x, _, _ = motion.reference([ELASTIC], ag)
    inner = np.nonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:]))[0] + 1
    # Height of each peak from the parabola through its three samples.
    curvature = x[inner - 1] - 2 * x[inner] + x[inner + 1]
    heights = x[inner] - (x[inner + 1] - x[inner - 1]) ** 2 / (8 * curvature)
    decrement = np.polyfit(np.arange(heights.size), np.log(heights), 1)[0]
    return float(-decrement / math.hypot(decrement, 2 * math.pi))


def largest_stable_delay(
    integrator: core.Integrator, compensated: bool, search: range = range(61)
) -> int:
    """Return the longest pure delay, samples, at which the elastic structure is stable."""
    push = np.zeros(round(40 * core.FS_HZ))
    push[:20] = 1.0
    last = -1
    for delay in search:
        law = fixed(float(delay)) if compensated else None
        x = simulate(
            InelasticCase(law, specimen=ELASTIC, delay=delay, integrator=integrator), push
        )["x_meas_m"]
        if x.size < push.size or rms(x[-x.size // 4 :]) > rms(x[x.size // 4 : x.size // 2]):
            break
        last = delay
    return last


COMPENSATIONS = {
    "none": InelasticCase(None),
    "RFC": InelasticCase(None, rfc=True),
    "PLC": InelasticCase(adaptive()),
    "PLC + RFC": InelasticCase(adaptive(), rfc=True),
    "PLC α = 10": InelasticCase(fixed(10.0)),
    "PLC α = 10 + RFC": InelasticCase(fixed(10.0), rfc=True),
}
INTEGRATORS: tuple[core.Integrator, ...] = (
    "forward-euler",
    "central-difference",
    "cr",
    "kr-alpha",
)


def study(record: str | Path | None = None) -> Study:
    """Reproduce Section 4.2 with TCU068, or with El Centro if TCU068 is not available.

    Args:
        record: file of TCU068 EW; None: it is taken from the package pyslammer.

    Raises:
        InputError: ``record`` cannot be read.
    """
    motion = tcu068(record)
    used = motion if motion is not None else ground_motion.builtin("elcentro-1940-ns")
    ag = excitation(used)
    x_exact, f_exact = exact(ag)
    runs = {name: simulate(case, ag) for name, case in COMPENSATIONS.items()}
    rows = grouped("The test", _test_rows(runs, x_exact, ag))
    rows += grouped("Compensation side by side", _compensation_rows(runs, x_exact))
    rows += grouped("Response NRMSE by adaptive gain, PLC only", _gain_rows(ag, x_exact))
    rows += grouped(
        "Controllers side by side: central difference, 2 µm and 20 N of noise, α₀ = 8",
        _controller_rows(ag),
    )
    if motion is None:
        # The bands apply to TCU068.
        rows = [replace(row, low=None, high=None) for row in rows]
    rows += grouped("Elastic structure without ground motion, for each integrator", _own_rows())
    return Study(
        "4.2",
        "Inelastic structure behind a delay of ten samples",
        f"T = 0.5 s, 2 %, Bouc-Wen specimen, forward Euler, {used.name} at 0.2 g for 50 s, then "
        "10 s of free vibration; the estimator starts at α = 0.",
        tuple(rows),
        _panels(runs, x_exact, f_exact),
        (
            "The adaptive gain is not stated; γ = 0.005 per mm² per sample converges at 13 s, as "
            "the paper's “more than 12 seconds”. With the gain that Section 4.1 needs, this test "
            "fails: one fixed gain cannot serve both.",
            "Forward Euler reduces the damping ratio by ωh/2: 2 % acts as 1.39 %, an error larger "
            "than the one left by PLC and RFC. “Exact” is the same integrator without delay.",
            "T0 is not stated here; 0.1 T = 51 samples is used.",
        ),
        ""
        if motion is not None
        else "Run with the built-in El Centro record, because TCU068 EW is not on this machine: "
        "the bands that depend on it do not apply. Give the record with --record FILE, or install "
        "the package pyslammer.",
    )


def _response(r: core.RecordArray, x_exact: Floats) -> float:
    """Return the response NRMSE, per cent."""
    return 100 * rms(r["x_meas_m"] - x_exact[: r.size]) / rms(x_exact[: r.size])


def _tracking(r: core.RecordArray) -> float:
    """Return the tracking NRMSE, per cent."""
    return 100 * rms(r["x_meas_m"] - r["x_num_m"]) / rms(r["x_num_m"])


def _accumulated(r: core.RecordArray, x_exact: Floats) -> Floats:
    """Return Eqn 4.3 over time, m."""
    return np.asarray(np.cumsum(np.abs(r["x_meas_m"] - x_exact[: r.size])))


def _test_rows(runs: dict[str, core.RecordArray], x_exact: Floats, ag: Floats) -> list[StudyRow]:
    alpha = runs["PLC"]["alpha"]
    converged = np.nonzero(np.abs(alpha / alpha[-1] - 1.0) > 0.05)[0]
    elastic = simulate(InelasticCase(None, specimen=ELASTIC), ag)["x_meas_m"]
    past = np.nonzero(np.abs(elastic) > 0.1)[0]
    total = {name: float(_accumulated(runs[name], x_exact)[-1]) for name in ("PLC", "PLC + RFC")}
    return [
        StudyRow("Peak displacement of the exact solution", float(np.abs(x_exact).max()) * 1e3,
            "mm", 36.24, 36.44),
        StudyRow("Time after which α stays within 5 % of its final value",
            float(converged.max(initial=0)) / core.FS_HZ, "s", 12.3, 14.3,
            "“more than 12 seconds”"),
        StudyRow("α at the end, PLC", float(alpha[-1]), "samples", 9.93, 9.99, "the delay is 10"),
        StudyRow("Accumulated error, ratio of PLC to PLC + RFC", total["PLC"] / total["PLC + RFC"],
            "", 5, None, "“much larger”"),
        StudyRow("Elastic specimen, no compensation: passes 100 mm at",
            float(past[0]) / core.FS_HZ if past.size else math.nan, "s", 11.0, 11.4),
    ]  # fmt: skip


def _compensation_rows(runs: dict[str, core.RecordArray], x_exact: Floats) -> list[StudyRow]:
    totals = {"PLC": (21.5, 23.5), "PLC + RFC": (2.9, 3.7)}
    responses = {"none": (50.0, None), "PLC + RFC": (None, 1.0)}
    rows = []
    for name, r in runs.items():
        low, high = totals.get(name, (None, None))
        least, most = responses.get(name, (None, None))
        total = float(_accumulated(r, x_exact)[-1])
        found = [
            StudyRow("Accumulated error", total, "m", low, high, "“much larger” with PLC only"),
            StudyRow("Response NRMSE", _response(r, x_exact), "%", least, most,
                "PLC agrees “rather well”"),
            StudyRow("Tracking NRMSE", _tracking(r), "%"),
        ]  # fmt: skip
        rows += [replace(row, case=name) for row in found]
    return rows


def _gain_rows(ag: Floats, x_exact: Floats) -> list[StudyRow]:
    bands = {0.005: (None, None), 0.1: (None, 3.0), 0.3: (10.0, None)}
    return [
        StudyRow("Response NRMSE",
            _response(simulate(InelasticCase(adaptive(gain)), ag), x_exact), "%", low, high,
            "“as long as a proper adaptive gain is tuned”", case=f"γ = {gain:g}")
        for gain, (low, high) in bands.items()
    ]  # fmt: skip


def _own_rows() -> list[StudyRow]:
    damping = {"forward-euler": 1.3865}
    delays = {"forward-euler": (2, 34), "central-difference": (3, 39)}

    def delay(name: core.Integrator, quantity: str, compensated: bool, search: range) -> StudyRow:
        expected = delays[name][compensated] if name in delays else None
        return StudyRow(
            quantity, largest_stable_delay(name, compensated, search), "samples",
            None if expected is None else expected - 1, None if expected is None else expected + 1,
        )  # fmt: skip

    rows = []
    for name in INTEGRATORS:
        expected = damping.get(name, 2.0)
        found = [
            StudyRow("Effective damping of the structure with 2 % nominal damping",
                100 * free_decay_ratio(name), "%", expected - 0.002, expected + 0.002, "2 %"),
            delay(name, "Longest stable delay, no compensation", False, range(8)),
            delay(name, "Longest stable delay, PLC", True, range(30, 48)),
        ]  # fmt: skip
        rows += [replace(row, case=name) for row in found]
    return rows


def _controller_rows(ag: Floats) -> list[StudyRow]:
    """Compare the controllers, all started 20 % off, as after a poor identification."""
    x_exact, _ = exact(ag, "central-difference")
    noise = 2e-6
    laws = {
        "none": None,
        "paper": adaptive(alpha0=8.0),
        "robust": core.LawConfig("robust", {"alpha0": 8.0}, rest_noise_m=noise),
        "alpha-beta": core.LawConfig("alpha-beta", {"alpha0": 8.0}, rest_noise_m=noise),
    }
    rows = []
    for name, law in laws.items():
        case = InelasticCase(
            law,
            rfc=law is not None,
            tangent="mean-of-ratios" if name == "paper" else "least-squares",
            integrator="central-difference",
            noise_std_m=noise,
            noise_std_n=20.0,
        )
        r = simulate(case, ag)
        best = name == "alpha-beta"
        rows += [
            StudyRow("Tracking NRMSE", _tracking(r), "%", None, 0.05 if best else None, case=name),
            StudyRow("Response NRMSE", _response(r, x_exact), "%", None, 0.5 if best else None,
                case=name),
        ]  # fmt: skip
    return rows


def _panels(
    runs: dict[str, core.RecordArray], x_exact: Floats, f_exact: Floats
) -> tuple[Panel, ...]:
    t = np.arange(x_exact.size) / core.FS_HZ
    plc, both, none = runs["PLC"], runs["PLC + RFC"], runs["none"]

    def over_time(r: core.RecordArray, field: str, factor: float) -> tuple[Floats, Floats]:
        return t[: r.size], r[field] * factor

    displacement = Panel(
        "fig-4-3", "Displacement (Fig. 4.3)", "time, s", "displacement, mm",
        (
            Curve("PLC", *over_time(plc, "x_meas_m", 1e3), "orange"),
            Curve("PLC + RFC", *over_time(both, "x_meas_m", 1e3), "blue", width=1.4),
            Curve("exact", t, x_exact * 1e3, "black", width=0.6),
        ),
    )  # fmt: skip
    difference = Panel(
        "difference-4-2", "Difference from the exact solution", "time, s", "x_m − x_exact, mm",
        (
            Curve("PLC", t[: plc.size], (plc["x_meas_m"] - x_exact[: plc.size]) * 1e3, "orange"),
            Curve("PLC + RFC", t[: both.size], (both["x_meas_m"] - x_exact[: both.size]) * 1e3,
                  "blue"),
        ),
        "While α still grows, only the force compensation keeps the response correct.",
    )  # fmt: skip
    uncompensated = Panel(
        "fig-4-3-none", "Without compensation", "time, s", "displacement, mm",
        (
            Curve("none", *over_time(none, "x_meas_m", 1e3), "red"),
            Curve("exact", t, x_exact * 1e3, "black", width=0.6),
        ),
        "A bounded limit cycle: yielding dissipates the energy that the delay adds.",
    )  # fmt: skip
    loops = Panel(
        "fig-4-4", "Hysteresis (Fig. 4.4)", "displacement, mm", "force, kN",
        (
            Curve("PLC", plc["x_meas_m"] * 1e3, plc["f_meas_n"] / 1e3, "orange"),
            Curve("PLC + RFC", both["x_meas_m"] * 1e3, both["f_meas_n"] / 1e3, "blue"),
            Curve("exact", x_exact * 1e3, f_exact / 1e3, "black", width=0.6),
        ),
        half=True,
    )  # fmt: skip
    errors = Panel(
        "fig-4-5", "Accumulated error (Fig. 4.5)", "time, s", "Σ |x_m − x_exact|, m",
        (
            Curve("PLC", t[: plc.size], _accumulated(plc, x_exact), "orange"),
            Curve("PLC + RFC", t[: both.size], _accumulated(both, x_exact), "blue"),
        ),
        half=True,
    )  # fmt: skip
    delay = Panel(
        "delay-4-2", "Delay estimate", "time, s", "α, samples",
        (
            Curve("PLC", *over_time(plc, "alpha", 1.0), "orange"),
            Curve("PLC + RFC", *over_time(both, "alpha", 1.0), "blue", dashed=True),
        ),
        y_range=(0, 12), levels=((10.0, "delay of the plant: 10"),),
    )  # fmt: skip
    return displacement, difference, uncompensated, loops, errors, delay
