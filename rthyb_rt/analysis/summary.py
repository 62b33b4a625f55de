"""Results of a recording as figures and sentences, shared by command line and report."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass, field, replace
from pathlib import PurePath
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import documents
from rthyb_rt.analysis import hysteresis, margins, measures, numerical_margins
from rthyb_rt.analysis.attention import SIGNALS, Finding, Judge, Subject
from rthyb_rt.analysis.hysteresis import Amplitude
from rthyb_rt.analysis.notices import (
    Notice,
    attention_in_words,
    flag_notices,
    not_finite_notices,
    omission_notices,
)
from rthyb_rt.config.deriving import structure_of_test
from rthyb_rt.config.numerical import Matrices
from rthyb_rt.config.numerical_structure import Structure, structure_of
from rthyb_rt.config.rate import Rate
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.config.testfile import TestFile
from rthyb_rt.core import FLAGS, RUNNING, STATES, Integrator, MotionConfig
from rthyb_rt.core.laws import LAWS, LawDescription, passes
from rthyb_rt.errors import InputError
from rthyb_rt.lab import trips
from rthyb_rt.lab.trips import Met
from rthyb_rt.numbers import count, delay, number, percent, quantity
from rthyb_rt.record.recording import OMITTED, RecordedTest

Floats = NDArray[np.float64]
NAN = float("nan")

USELESS_NRMSE = 0.5
"""With an error of more than half of the motion, no result of a test can be used."""
FARTHEST_M = 2.0
"""No actuator in a laboratory moves farther: a motion beyond this has diverged."""
_MOVING = [STATES.index(name) for name in ("RAMP_IN", "RUNNING", "HOLD", "RAMP_OUT")]
OUT_OF_RANGE = 1 << 1
"""Bit of the field ``code``: a value was implausible and was discarded."""


@dataclass(frozen=True)
class SummarySettings:
    """Settings from test and rig file for measures and figures; None if not given.

    Attributes:
        controller: name of the controller.
        plc_enabled: whether the delay was compensated.
        estimator_enabled: whether the delay estimate could change.
        rfc_enabled: whether force compensation was on.
        alpha_min: lower bound of the delay estimate, samples.
        alpha_max: upper bound of the delay estimate, samples.
        alpha_identified: delay found by identification of the rig, samples.
        alpha_start: delay estimate with which the test starts, samples.
        k_e_n_per_m: elastic stiffness of the specimen, N/m.
        mass_kg: mass of the numerical part, kg.
        period_s: period of the whole structure, s.
        damping_n_s_per_m: damping of the numerical part, N s/m.
        damping_ratio: the same as a fraction of critical damping.
        critical_delay_samples: longest pure delay for which the structure is stable; inf: any.
        window_samples: window T0 of the tangent stiffness.
        tangent: method of finding the tangent stiffness.
        gain: adaptation gain of the delay estimator with its unit, as text.
        limits: value of each limit that is set, by key, SI.
        reference_peak_m: of the reference simulation; None without one.
        reference_peak_n: the same for its force.
        description: the test file's.
        rig_name: name of the rig.
        fs_hz: sample rate of the test, which relates samples to milliseconds.
        history: the prescribed history, as text; "": a hybrid test.
        time_scale: seconds in the laboratory per second of the structure; masses, damping and
            periods are given in the laboratory's time.
        omitted: notes on values that the rig file omitted.
    """

    controller: str | None
    plc_enabled: bool
    estimator_enabled: bool
    rfc_enabled: bool
    alpha_min: float | None
    alpha_max: float | None
    alpha_identified: float | None
    k_e_n_per_m: float | None
    mass_kg: float | None
    period_s: float | None
    damping_n_s_per_m: float | None
    damping_ratio: float | None
    critical_delay_samples: float | None
    window_samples: int | None
    tangent: str | None
    gain: str | None
    limits: dict[str, float]
    reference_peak_m: float | None
    reference_peak_n: float | None
    description: str
    rig_name: str
    fs_hz: float
    history: str = ""
    time_scale: float = 1.0
    alpha_start: float | None = None
    omitted: tuple[str, ...] = ()


def setup(rec: RecordedTest) -> SummarySettings:
    """Return the settings that the measures need from the two resolved files.

    Tolerant, since a recording of another version must still give a report.
    """
    test, rig = map(documents.toml_if_valid, (rec.test_toml, rec.rig_toml))
    name = _get(test, "controller", "type")
    controller = name if isinstance(name, str) else None
    compensated = not passes(controller)
    k_e = _positive(_get(rig, "rig", "elastic_stiffness_n_per_m"))
    mass = _positive(_get(test, "numerical", "mass_kg"))
    period = _positive(_get(test, "numerical", "period_s"))
    damping = _number(_get(test, "numerical", "damping_n_s_per_m"))
    ratio = _number(_get(test, "numerical", "damping_ratio"))
    # Either mass or period is given; the other follows with the stiffness of both parts.
    if k_e is not None:
        k = k_e + (_number(_get(test, "numerical", "stiffness_n_per_m")) or 0.0)
        if period is None and mass is not None and k > 0.0:
            period = 2.0 * np.pi * float(np.sqrt(mass / k))
        elif mass is None and period is not None:
            mass = k * (period / (2.0 * np.pi)) ** 2
    if mass is not None and period is not None:
        critical = 4.0 * np.pi * mass / period
        if damping is None and ratio is not None:
            damping = ratio * critical
        elif damping is not None:
            ratio = damping / critical
    slow = _positive(_get(test, "test", "time_scale")) or 1.0
    mass, damping, period = _times(mass, slow**2), _times(damping, slow), _times(period, slow)
    rate = Rate(rec.fs_hz)
    critical_delay = _critical_delay(test, mass, damping, k_e, rate)
    structure = structure_of_recording(test, k_e, rate)
    if structure is not None:
        first = structure.first()
        period = 1.0 / first.frequency_hz if first.frequency_hz else None
        ratio, critical_delay = (
            first.damping_ratio,
            margins.critical_delay(numerical_margins.ManyDegrees(structure)),
        )
    window = _times(_number(_get(test, "controller", "rfc", "window_samples")), rate.pace)
    if window is None:
        window = _times(_number(_get(test, "controller", "rfc", "window_s")), rate.hz)
    plc = compensated and _get(test, "controller", "plc_enabled") is not False
    estimator = ("controller", "delay_estimator")
    law = LAWS.get(controller or "")
    # The table exists for every law; a law unknown to this version may have its own keys.
    bounded = law is None or law.parameter("delay_estimator.alpha_min") is not None
    return SummarySettings(
        controller=controller,
        plc_enabled=plc,
        estimator_enabled=plc
        and (law is None or law.learns)
        and _get(test, *estimator, "enabled") is not False,
        rfc_enabled=compensated and _get(test, "controller", "rfc", "enabled") is not False,
        alpha_min=_times(_number(_get(test, *estimator, "alpha_min")), rate.pace)
        if bounded
        else None,
        alpha_max=_times(_number(_get(test, *estimator, "alpha_max")), rate.pace)
        if bounded
        else None,
        alpha_identified=_times(_number(_get(rig, "identified", "alpha")), rate.pace),
        k_e_n_per_m=k_e,
        mass_kg=mass,
        period_s=period,
        damping_n_s_per_m=damping,
        damping_ratio=ratio,
        critical_delay_samples=critical_delay,
        window_samples=None if window is None else round(window),
        tangent=_words(_get(test, "controller", "rfc", "tangent")) or None,
        gain=_gain(law, _get(test, "controller"), rate),
        limits=_limits(test),
        reference_peak_m=_reference_peak(rec, "x_ref_m"),
        reference_peak_n=_reference_peak(rec, "f_ref_n"),
        description=_words(_get(test, "test", "description")),
        rig_name=_words(_get(rig, "rig", "name")),
        fs_hz=rate.hz,
        history=_words(rec.ground_motion.get("name")) if _get(test, "history") else "",
        time_scale=slow,
        alpha_start=_times(_number(_get(test, "controller", "alpha0")), rate.pace),
        omitted=omitted(rec),
    )


def omitted(rec: RecordedTest) -> tuple[str, ...]:
    """Return the notes on values that the rig file of a recording omitted."""
    found = rec.meta.get(OMITTED)
    return tuple(map(str, found)) if isinstance(found, list) else ()


def recorded_structure(rec: RecordedTest) -> Structure | SparseStructure | None:
    """Return the numerical part of a recording if it has many degrees of freedom, else None."""
    test, rig = map(documents.toml_if_valid, (rec.test_toml, rec.rig_toml))
    k_e = _positive(_get(rig, "rig", "elastic_stiffness_n_per_m"))
    return structure_of_recording(test, k_e, Rate(rec.fs_hz))


def structure_of_recording(
    test: dict[str, Any], k_e: float | None, rate: Rate
) -> Structure | SparseStructure | None:
    """Return a numerical part with many degrees of freedom; None if there is none to be read.

    Args:
        test: the test file as recorded.
        k_e: elastic stiffness of the specimen, N/m.
        rate: of the test.
    """
    if k_e is None or not isinstance(_get(test, "numerical"), dict):
        return None
    matrices = _get(test, "numerical", "matrices")
    try:
        of_file = isinstance(matrices, dict) and "data" in matrices
        if of_file or _get(test, "numerical", "storeys") is not None:
            return structure_of_test(TestFile.model_validate(test), k_e, rate.period_s)
        if not isinstance(matrices, dict):
            return None
        slow = _positive(_get(test, "test", "time_scale")) or 1.0
        return structure_of(Matrices.model_validate(matrices), k_e, rate.period_s).slowed(slow)
    except (ValueError, InputError):
        # From another version.
        return None


def _critical_delay(
    test: dict[str, Any],
    mass: float | None,
    damping: float | None,
    k_e: float | None,
    rate: Rate,
) -> float | None:
    """Return the critical delay as in `rthyb check`; None if the files are incomplete."""
    integrator = _get(test, "numerical", "integrator")
    if mass is None or damping is None or k_e is None or not isinstance(integrator, str):
        return None
    motion = MotionConfig(
        cast(Integrator, integrator),
        mass_kg=mass,
        damping_n_s_per_m=damping,
        stiffness_n_per_m=_number(_get(test, "numerical", "stiffness_n_per_m")) or 0.0,
        k_e_n_per_m=k_e,
        rho_inf=_number(_get(test, "numerical", "rho_inf")) or 0.0,
        period_s=rate.period_s,
    )
    try:
        return _critical_delay_of(motion)
    except ValueError:
        # An integrator unknown to this version.
        return None


@functools.lru_cache(maxsize=16)
def _critical_delay_of(motion: MotionConfig) -> float:
    """Return the critical delay of a structure, which the repetitions of a test share."""
    return margins.critical_delay(margins.OneDegree(motion))


def _limits(test: dict[str, Any]) -> dict[str, float]:
    given = _get(test, "limits")
    values = {
        key: _number(item.get("value") if isinstance(item, dict) else item)
        for key, item in (given.items() if isinstance(given, dict) else ())
    }
    return {key: value for key, value in values.items() if value is not None}


def _reference_peak(rec: RecordedTest, name: str) -> float | None:
    peak = NAN if rec.reference is None else _peak(rec.reference[name])
    return peak if peak > 0.0 else None


def _gain(law: LawDescription | None, controller: Any, rate: Rate) -> str | None:
    """Return the setting that a control law's table declares for display, as text."""
    said = []
    for parameter in law.parameters if law else ():
        value = _number(_get(controller, *parameter.key.split(".")))
        if value is not None and parameter.words is not None:
            # In files, samples are always of 1/1024 s, whatever the rate of the test.
            of = " of 1/1024 s" if parameter.words.endswith("sample") and rate.pace != 1.0 else ""
            said.append(parameter.words.format(f"{value:g}") + of)
    return ", ".join(said) or None


def _words(value: Any) -> str:
    return value if isinstance(value, str) else ""


def _get(tree: Any, *path: str) -> Any:
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _number(value: Any) -> float | None:
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value)
    return float(value) if usable else None


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0.0 else None


@dataclass(frozen=True)
class Live:
    """How a test in real time went, apart from its results.

    Attributes:
        in_real_time: False if ticks were triggered externally: by the stepped clock, or by a link
            with a Python thread in between.
        cause: what ended the test, as named by the station.
        link: name of the link.
        wake_p50_ns, wake_p99_ns, wake_max_ns: delay of the wake-up after the due time.
        sent_p99_ns: from wake-up to sending of the command.
        skipped_ticks: ticks that were not executed.
        lost_pairs: ticks of the motion without a pair from the drive.
        slips: how often the drive's clock gained or lost a sample during the motion.
        link_delay_samples: from command to feedback on the wire, median of the test proper; -1: not
            known.
        link_delay_ms: the same in milliseconds; None: not known.
        missed_rows: rows that were overwritten before the recorder read them.
        privileges: obtained by the tick thread.
        remedy: what to do about the cause; "" if nothing.
    """

    in_real_time: bool
    cause: str
    link: str
    wake_p50_ns: int
    wake_p99_ns: int
    wake_max_ns: int
    sent_p99_ns: int
    skipped_ticks: int
    lost_pairs: int
    slips: int
    link_delay_samples: int
    link_delay_ms: float | None
    missed_rows: int
    privileges: tuple[str, ...]
    remedy: str


def live(rec: RecordedTest) -> Live | None:
    """Return how a test in real time went; None for a test in virtual time."""
    facts = rec.meta.get("real_time")
    if not isinstance(facts, dict):
        return None
    from rthyb_rt.lab import end_reasons

    wake, sent = facts["wake"], facts["sent"]
    moving = rec.samples[_motion(rec)]
    accounted = FLAGS["fresh"] | FLAGS["blind"]
    return Live(
        in_real_time=bool(facts["in_real_time"]),
        cause=str(facts["cause"]),
        link=str(facts["link"]),
        wake_p50_ns=int(wake["p50_ns"]),
        wake_p99_ns=int(wake["p99_ns"]),
        wake_max_ns=int(wake["max_ns"]),
        sent_p99_ns=int(sent["p99_ns"]),
        skipped_ticks=int(facts["ticks"]["skipped"]),
        lost_pairs=int(np.count_nonzero((moving["flags"] & accounted) == 0)),
        slips=int(np.count_nonzero(moving["flags"] & FLAGS["slip"])),
        link_delay_samples=(samples := int(facts["link_delay_samples"])),
        link_delay_ms=None if samples < 0 else 1e3 * samples / rec.fs_hz,
        missed_rows=sum(last - first + 1 for first, last in facts["missed_rows"]),
        privileges=tuple(facts["privileges"]),
        remedy=end_reasons.remedy(
            str(facts["cause"]), rec.samples, rec.fs_hz, _own_part(rec.test_toml)
        ),
    )


def _own_part(test_toml: str) -> str:
    """Return the file name of the library or FMU that is the numerical part of a test, or ""."""
    test = documents.toml_if_valid(test_toml)
    files = (_get(test, "numerical", kind, "file") for kind in ("library", "fmu"))
    return next((PurePath(file).name for file in files if isinstance(file, str)), "")


def _motion(rec: RecordedTest) -> NDArray[np.bool_]:
    """Return which rows contain motion, including ramps, shape (n,)."""
    mask: NDArray[np.bool_] = np.isin(rec.samples["state"], _MOVING)
    return mask


@dataclass(frozen=True)
class Summary:
    """Results of a test; fractions and SI units, nan or None if not defined.

    ``attention`` lists what went wrong although the test may have completed, the most serious
    first; ``ended_by`` the cause that interrupted it, or None; ``loops`` the results of the cycles
    of a prescribed history, by amplitude. Errors, indices and flags are taken over the rows of the
    test proper.
    """

    test_name: str
    end_reason: str
    interrupted: bool
    clock: str
    final_state: str
    fs_hz: float
    samples: int
    test_samples: int
    duration_s: float
    peak_command_m: float
    peak_command_time_s: float
    peak_measured_m: float
    peak_force_n: float
    tracking_nrmse: float
    tracking_peak_difference_m: float
    tracking_peak_error: float
    response_nrmse: float | None
    response_peak_difference_m: float | None
    response_peak_error: float | None
    accumulated_error_m: float | None
    fei_amplitude: float
    fei_delay_s: float
    fei_frequency_hz: float
    alpha_end: float
    alpha_at_bound: float
    k_t_at_zero: float
    tracking_indicator_m2: float
    energy_error_j: float
    energy_error_largest_j: float
    energy_error_relative: float | None
    input_energy_j: float | None
    clamped_rows: int
    flags: dict[str, int]
    skipped_ticks: int
    not_finite_rows: int
    attention: tuple[Finding, ...]
    ended_by: Met | None
    live: Live | None
    setup: SummarySettings = field(repr=False)
    loops: tuple[Amplitude, ...] = ()

    @property
    def ending(self) -> str:
        """The limit that ended the test, with its value and further facts; "" if none did."""
        return "" if self.ended_by is None else trips.sentence(self.ended_by, self.setup)

    @property
    def never_began(self) -> bool:
        """Whether a test in real time ended before its first sample."""
        return self.live is not None and self.test_samples == 0

    def as_json(self) -> dict[str, Any]:
        """Return the results as a JSON document: nan, which JSON does not have, becomes None."""
        return {key: json_value(value) for key, value in asdict(self).items()}


def json_value(value: Any) -> Any:
    """Return a value as JSON has it: nan becomes None."""
    if isinstance(value, dict):
        return {key: json_value(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [json_value(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


_NEVER: dict[str, Any] = dict.fromkeys(
    (
        "tracking_nrmse", "tracking_peak_difference_m", "tracking_peak_error", "fei_amplitude",
        "fei_delay_s", "fei_frequency_hz", "k_t_at_zero", "tracking_indicator_m2",
        "energy_error_j", "energy_error_largest_j",
    ),
    float("nan"),
) | dict.fromkeys(
    (
        "response_nrmse", "response_peak_difference_m", "response_peak_error",
        "accumulated_error_m", "energy_error_relative", "input_energy_j",
    )
)  # fmt: skip
"""Results that exist for the test proper only."""


def _bare(found: Summary) -> Summary:
    """Return the summary of a test that never began, without figures of rest and ramps."""
    return replace(found, duration_s=0.0, attention=(), **_NEVER)


def ending(rec: RecordedTest, running: int) -> str:
    """Return the limit that ended a test, with its value, from a recording without its rows.

    Args:
        rec: the recording; its rows are not used.
        running: number of rows of the test proper.

    Returns:
        As `Summary.ending`.
    """
    given = setup(rec)
    met = trips.found(replace(rec, samples=rec.samples[:0]), given)
    return "" if met is None else trips.sentence(replace(met, time_s=running / rec.fs_hz), given)


def reference_pair(rec: RecordedTest) -> tuple[NDArray[np.intp], Floats] | None:
    """Return the rows with a reference and the reference displacement at these rows, m.

    Row k of the reference belongs to the k-th row of the test proper. None without a reference.
    """
    if rec.reference is None:
        return None
    rows = np.flatnonzero(rec.running())
    length = min(rows.size, len(rec.reference))
    return (rows[:length], rec.reference["x_ref_m"][:length]) if length else None


def subject(given: SummarySettings, fs_hz: float) -> Subject:
    """Return what must be known about a test to judge its rows."""
    critical = given.critical_delay_samples
    return Subject(
        fs_hz=fs_hz,
        peak_m=given.reference_peak_m,
        damping_n_s_per_m=given.damping_n_s_per_m,
        k_e_n_per_m=given.k_e_n_per_m,
        rfc_enabled=given.rfc_enabled,
        delay_samples=given.alpha_identified if given.plc_enabled else None,
        margin_samples=None if critical is None else margins.delay_margin(critical),
    )


def summarize(rec: RecordedTest) -> Summary:
    """Return the results of a recording.

    The energy error is computed from the recorded signals, not taken from the core's running value,
    so that recordings from other sources are judged in the same way.
    """
    given = setup(rec)
    samples = rec.samples
    running = rec.running()
    run = _selected(samples, running)
    how = live(rec)
    flagged = np.ascontiguousarray(run["flags"])
    if how is not None and not (run["state"] == RUNNING).any():
        flagged = flagged[:0]
    # Contiguous copies: each is read a dozen times, and a recorded row exceeds a cache line.
    columns = {name: np.ascontiguousarray(run[name]) for name in SIGNALS}
    x_num, x_meas, force, k_t, alpha = columns.values()
    index = measures.fei(x_num, x_meas, rec.fs_hz)
    peak_row = _peak_row(x_num)
    error_j = measures.energy_error(force, x_num, x_meas)
    relative = input_j = None
    if given.mass_kg is not None:
        input_j = measures.input_energy(run["ag_mps2"], x_num, given.mass_kg)
    if given.k_e_n_per_m is not None and not given.history:
        relative = measures.hsem(error_j, input_j, force, given.k_e_n_per_m)
    response: dict[str, float | None] = dict.fromkeys(("nrmse", "difference", "error", "sum"))
    pair = reference_pair(rec)
    if pair is not None:
        measured = samples["x_meas_m"][pair[0]]
        response = {
            "nrmse": measures.response_nrmse(pair[1], measured),
            "difference": measures.peak_difference(pair[1], measured),
            "error": measures.peak_error(pair[1], measured),
            "sum": float(measures.accumulated_error(pair[1], measured)[-1]),
        }
    judge = Judge(subject(given, rec.fs_hz))
    judge.add(columns, None if pair is None else pair[1])
    signals = np.stack([samples[n] for n in ("x_num_m", "x_cmd_m", "x_meas_m", "f_meas_n")])
    state = int(samples["state"][-1]) if len(samples) else 0
    found = Summary(
        test_name=str(rec.meta.get("test_name", "")),
        end_reason=str(rec.meta.get("end_reason", "unknown")),
        interrupted=bool(rec.meta.get("interrupted", False)),
        clock=str(rec.meta.get("clock", "unknown")),
        final_state=STATES[state] if state < len(STATES) else str(state),
        fs_hz=rec.fs_hz,
        samples=len(samples),
        test_samples=len(flagged),
        duration_s=len(run) / rec.fs_hz,
        peak_command_m=_peak(x_num),
        peak_command_time_s=float(rec.time_s()[running][peak_row]) if len(run) else NAN,
        peak_measured_m=_peak(x_meas),
        peak_force_n=_peak(force),
        tracking_nrmse=measures.tracking_nrmse(x_num, x_meas),
        tracking_peak_difference_m=measures.peak_difference(x_num, x_meas),
        tracking_peak_error=measures.peak_error(x_num, x_meas),
        response_nrmse=response["nrmse"],
        response_peak_difference_m=response["difference"],
        response_peak_error=response["error"],
        accumulated_error_m=response["sum"],
        fei_amplitude=index.amplitude,
        fei_delay_s=index.delay_s,
        fei_frequency_hz=index.f_eq_hz,
        alpha_end=float(alpha[-1]) if len(run) else NAN,
        alpha_at_bound=_share_at_bound(alpha, given),
        k_t_at_zero=_share(k_t <= 0.0),
        tracking_indicator_m2=_last(measures.tracking_indicator(x_num, x_meas)),
        energy_error_j=_last(error_j),
        energy_error_largest_j=float(np.max(np.abs(error_j), initial=0.0)),
        energy_error_relative=relative,
        input_energy_j=None if input_j is None else float(np.max(input_j, initial=0.0)),
        clamped_rows=_clamped_rows(samples),
        flags={name: int(np.count_nonzero(flagged & bit)) for name, bit in FLAGS.items()},
        skipped_ticks=rec.replay.skipped_ticks,
        not_finite_rows=int(np.count_nonzero(~np.isfinite(signals).all(axis=0))),
        attention=tuple(judge.findings()),
        ended_by=trips.found(rec, given),
        live=how,
        setup=given,
        loops=hysteresis.amplitudes(rec) if given.history else (),
    )
    return _bare(found) if found.never_began else found


def _selected(samples: NDArray[np.void], mask: NDArray[np.bool_]) -> NDArray[np.void]:
    """Return the rows of a mask, without a copy if they are contiguous, as in a normal test."""
    count = int(np.count_nonzero(mask))
    first = int(np.argmax(mask)) if count else 0
    if mask[first : first + count].all():
        return samples[first : first + count]
    return samples[mask]


def stiffness_shares(
    k_t: Floats, k_e: float | None, fs_hz: float, step_s: float = 1.0
) -> tuple[Floats, Floats]:
    """Return the bounds at which the tangent stiffness was, for each step of the test.

    Args:
        k_t: tangent stiffness, shape (n,); non-finite values count as between the bounds.
        k_e: upper bound in the same unit, None if not known.
        fs_hz: sample rate.
        step_s: length of a step, s.

    Returns:
        Edges of the steps from the first sample, s, shape (m + 1,), and the share of samples per
        step at 0, between the bounds, and at k_e, shape (3, m). The last step may be short.
    """
    width = max(round(step_s * fs_hz), 1)
    starts = np.arange(0, k_t.size, width)
    edges = np.append(starts, k_t.size) / fs_hz
    if not k_t.size:
        return edges, np.zeros((3, 0))
    at_zero = k_t <= 0.0
    at_top = np.zeros(k_t.shape, dtype=np.bool_) if k_e is None else k_t >= k_e * (1.0 - 1e-9)
    counts = np.diff(np.append(starts, k_t.size))
    low, high = (np.add.reduceat(mask.astype(np.float64), starts) / counts
                 for mask in (at_zero, at_top))  # fmt: skip
    return edges, np.stack([low, 1.0 - low - high, high])


def _clamped_rows(samples: NDArray[np.void]) -> int:
    """Count the rows in which a computed value was discarded; lost feedback is counted apart."""
    held = (samples["code"] & OUT_OF_RANGE) != 0
    return int(np.count_nonzero(held & ((samples["flags"] & FLAGS["predicted"]) == 0)))


def _peak_row(x: Floats) -> int:
    magnitude = np.where(np.isfinite(x), np.abs(x), -1.0)
    return int(np.argmax(magnitude)) if x.size else 0


def _peak(x: Floats) -> float:
    finite = np.abs(x[np.isfinite(x)])
    return float(np.max(finite)) if finite.size else NAN


def _last(x: Floats) -> float:
    return float(x[-1]) if x.size else NAN


def _share(mask: NDArray[np.bool_]) -> float:
    return float(np.mean(mask)) if mask.size else 0.0


def _share_at_bound(alpha: Floats, given: SummarySettings) -> float:
    if not given.estimator_enabled:
        return 0.0
    at_bound = np.zeros(alpha.shape, dtype=np.bool_)
    if given.alpha_min is not None:
        at_bound |= alpha <= given.alpha_min
    if given.alpha_max is not None:
        at_bound |= alpha >= given.alpha_max
    return _share(at_bound)


# --- words ------------------------------------------------------------------------------------


def verdict(s: Summary) -> str:
    """Return the result in one sentence, with the tracking beside any response error."""
    if s.never_began:
        return "The test proper never began: there is nothing to evaluate."
    if np.isnan(s.peak_command_m):
        return "The recording contains no finite command: there is nothing to evaluate."
    if s.peak_command_m == 0.0:
        still = np.isnan(s.peak_measured_m) or s.peak_measured_m == 0.0
        moved = "" if still else f", although {_mm(s.peak_measured_m)} was measured"
        return f"The command stayed at zero{moved}: there is no motion to evaluate."
    tracking = (
        f"The specimen followed the command within {_mm(s.tracking_peak_difference_m)} "
        f"({percent(s.tracking_peak_error)})"
    )
    if s.setup.history:
        return f"{tracking}{_loops_in_words(s.loops)}."
    if s.response_peak_difference_m is None:
        return f"{tracking}; there is no reference simulation to compare the response with."
    return (
        f"{tracking}; the response differs from the reference simulation by at most "
        f"{_mm(s.response_peak_difference_m)} ({percent(s.response_peak_error)})."
    )


def _loops_in_words(loops: tuple[Amplitude, ...]) -> str:
    if not loops:
        return ""
    largest = max(loops, key=lambda one: one.amplitude_m)
    return (
        f"; at {quantity(largest.amplitude_m, 'mm', 1e3)} its secant stiffness was "
        f"{quantity(largest.last.secant_n_per_m, 'kN/m', 1e-3)}, its equivalent damping "
        f"{percent(largest.last.damping_ratio)}"
    )


def _mm(value_m: float | None) -> str:
    return quantity(value_m, "mm", 1e3, digits=2)


def notices(s: Summary) -> list[Notice]:
    """Return the notices, the most serious first."""
    found: list[Notice] = []
    if s.end_reason != "completed":
        how = f", {s.ending}" if s.ending else f" after {s.duration_s:.2f} s"
        found.append(Notice("alarm", f"The test did not complete: {s.end_reason}{how}."))
        if s.live is not None and s.live.remedy:
            found.append(Notice("note", s.live.remedy))
    if s.interrupted:
        found.append(Notice("alarm", "The test was held, so it is not one continuous motion."))
    found += not_finite_notices(s.not_finite_rows)
    found += _useless(s)
    found += [Notice("alarm", attention_in_words(one, s.setup, s.attention)) for one in s.attention]
    found += flag_notices(s.flags, s.test_samples, s.skipped_ticks)
    found += live_notices(s.live)
    if s.alpha_at_bound > 0.01:
        share = percent(s.alpha_at_bound)
        found.append(
            Notice("alarm", f"The delay estimate was at one of its bounds for {share} of the test.")
        )
    reported = any(one.kind == "stiffness" for one in s.attention)
    if s.setup.rfc_enabled and s.k_t_at_zero > 0.01 and not reported:
        share = percent(s.k_t_at_zero)
        found.append(
            Notice(
                "note",
                f"No force compensation for {share} of the test: the tangent stiffness was zero.",
            )
        )
    return found + omission_notices(s.setup.omitted)


def live_notices(found: Live | None) -> list[Notice]:
    """Return the notices about a test in real time."""
    if found is None:
        return []
    notices = []
    if found.slips:
        notices.append(
            Notice(
                "alarm",
                "The clocks of the drive and of this PC drifted apart by "
                f"{count(found.slips, 'sample')}: the delay estimate contains steps that are not "
                "caused by the rig.",
            )
        )
    if found.missed_rows:
        notices.append(
            Notice("alarm", f"{count(found.missed_rows, 'row')} missing from the recording.")
        )
    if not found.in_real_time:
        notices.append(Notice("note", "The test did not run in real time."))
    return notices


def _useless(s: Summary) -> list[Notice]:
    """Return why the results of a diverged or failed test are meaningless."""
    texts = []
    peak_m = max(np.nan_to_num([s.peak_command_m, s.peak_measured_m], nan=0.0))
    if peak_m > FARTHEST_M:
        texts.append(
            f"The motion diverged to {quantity(float(peak_m), 'm')}, farther than any laboratory "
            "actuator can move."
        )
    if s.clamped_rows:
        texts.append(
            f"{count(s.clamped_rows, 'sample')} of {s.samples} had an implausible value, "
            "which was discarded: the motion is not that of the structure."
        )
    for name, of, value in (
        ("Response", "reference simulation", s.response_nrmse),
        ("Tracking", "command", s.tracking_nrmse),
    ):
        if value is not None and value > USELESS_NRMSE:
            texts.append(
                f"{name} NRMSE {percent(value)}: the measured motion is not that of the {of}."
            )
    input_j = s.input_energy_j
    if input_j is not None and 0.0 < input_j < s.energy_error_largest_j:
        texts.append(
            f"The tracking error transferred {quantity(s.energy_error_largest_j, 'J')} to or from "
            f"the structure, more than the {quantity(input_j, 'J')} that the ground motion "
            "supplied."
        )
    return [Notice("alarm", text) for text in texts]


def key_figures(s: Summary) -> list[str]:
    """Return the key properties of a test as short texts: structure or history, controller, window.

    Period, mass and damping are given in the structure's own time.
    """
    given, slow = s.setup, s.setup.time_scale
    figures = [
        ("T = ", quantity(_times(given.period_s, 1.0 / slow), "s")),
        ("m = ", quantity(_times(given.mass_kg, slow**-2), "kg", digits=4)),
        ("c = ", quantity(_times(given.damping_n_s_per_m, 1.0 / slow), "N s/m", digits=4)),
        ("ζ = ", percent(given.damping_ratio, 3)),
        ("k_e = ", quantity(given.k_e_n_per_m, "kN/m", 1e-3, 4)),
    ]
    found = [name + value for name, value in figures if value != "–"]
    if given.history:
        found.insert(0, given.history)
    if given.time_scale != 1.0:
        found.append(f"time scale {given.time_scale:g}")
    if given.controller is not None:
        adapts = given.gain is not None and given.estimator_enabled
        found.append(f"controller {given.controller}" + (f", {given.gain}" if adapts else ""))
    if given.rfc_enabled and given.window_samples is not None:
        found.append(f"T0 = {count(given.window_samples, 'sample')}")
    return found


class SummaryRow(NamedTuple):
    """One row of the result table: label, value, definition."""

    label: str
    value: str
    formula: str


def result_table(rec: RecordedTest) -> list[SummaryRow]:
    """Return the result table of a recording: label, value with unit, definition.

    Definitions and sources are given in `rthyb_rt.analysis.measures`.
    """
    return table(summarize(rec))


def table(s: Summary) -> list[SummaryRow]:
    """Return the result table of a summary."""
    rows = [
        SummaryRow("Result", _end(s), ""),
        *_limit_rows(s.ended_by),
        SummaryRow("Peak command", quantity(s.peak_command_m, "mm", 1e3), "max |x_num|"),
        SummaryRow("Peak displacement", quantity(s.peak_measured_m, "mm", 1e3), "max |x_meas|"),
        SummaryRow("Peak force", quantity(s.peak_force_n, "kN", 1e-3), "max |f|"),
        SummaryRow(
            "Tracking, NRMSE", percent(s.tracking_nrmse), "rms(x_meas − x_num) / rms(x_num)"
        ),
        SummaryRow(
            "Tracking, largest difference",
            f"{quantity(s.tracking_peak_difference_m, 'mm', 1e3)} "
            f"({percent(s.tracking_peak_error)})",
            "max |x_meas − x_num|, of max |x_num|",
        ),
    ]
    if s.setup.history:
        rows += _loop_rows(s.loops)
    elif s.response_nrmse is None:
        rows.append(SummaryRow("Response", "no reference simulation", ""))
    else:
        rows += [
            SummaryRow(
                "Response, NRMSE", percent(s.response_nrmse), "rms(x_meas − x_ref) / rms(x_ref)"
            ),
            SummaryRow(
                "Response, largest difference",
                f"{quantity(s.response_peak_difference_m, 'mm', 1e3)} "
                f"({percent(s.response_peak_error)})",
                "max |x_meas − x_ref|, of max |x_ref|",
            ),
            SummaryRow(
                "Accumulated error",
                quantity(s.accumulated_error_m, "m"),
                "Σ |x_meas − x_ref| over samples, Eqn 4.3",
            ),
        ]
    at = "" if np.isnan(s.fei_frequency_hz) else f" at {number(s.fei_frequency_hz)} Hz"
    rows += [
        SummaryRow(
            "Remaining delay",
            f"{quantity(s.fei_delay_s, 'ms', 1e3)} "
            f"({quantity(s.fei_delay_s, 'samples', s.fs_hz)}){at}"
            if at
            else "–",
            "frequency evaluation index of x_meas against x_num",
        ),
        SummaryRow("Amplitude ratio", number(s.fei_amplitude, 4), "|FEI|; 1 is ideal"),
        SummaryRow("Final delay estimate", _alpha(s), "alpha"),
        *([] if s.setup.history else [_energy_row(s)]),
        SummaryRow(
            "Tracking indicator",
            quantity(s.tracking_indicator_m2, "mm²", 1e6),
            "½ ∫ (x_meas dx_num − x_num dx_meas); negative: lag",
        ),
        SummaryRow("Samples", _samples(s), "rows of the recording, and flagged rows"),
    ]
    return rows + live_rows(s.live)


def _energy_row(s: Summary) -> SummaryRow:
    return SummaryRow(
        "Energy error",
        f"{quantity(s.energy_error_j, 'J')}"
        + (
            f", at most {percent(s.energy_error_relative)} of the energy in the test"
            if s.energy_error_relative is not None
            else ""
        ),
        "∫ f d(x_meas − x_num); positive adds energy",
    )


def _loop_rows(loops: tuple[Amplitude, ...]) -> list[SummaryRow]:
    return [
        SummaryRow(
            f"Loops at {quantity(one.amplitude_m, 'mm', 1e3)}",
            f"{quantity(one.last.secant_n_per_m, 'kN/m', 1e-3)}, "
            f"{quantity(one.last.energy_j, 'J')} a cycle, damping "
            f"{percent(one.last.damping_ratio)}",
            f"secant, ∮ f dx, E / 2πkX² of the last of {count(len(one.loops), 'cycle')}",
        )
        for one in loops
    ]


def _limit_rows(met: Met | None) -> list[SummaryRow]:
    text = "" if met is None else trips.figures(met.cause, met.value, met.limit)
    return [SummaryRow("Limit reached", text, "first cause")] if text else []


def live_rows(found: Live | None) -> list[SummaryRow]:
    """Return the result rows of a test in real time; none for a test in virtual time."""
    if found is None:
        return []
    wake = ", ".join(
        f"{name} {_microseconds(ns)}"
        for name, ns in (
            ("p50", found.wake_p50_ns),
            ("p99", found.wake_p99_ns),
            ("longest", found.wake_max_ns),
        )
    )
    delay = "not known"
    if found.link_delay_ms is not None:
        samples = count(found.link_delay_samples, "sample")
        delay = f"{samples} ({number(found.link_delay_ms)} ms)"
    punctuality = SummaryRow(
        "Punctuality",
        f"{wake}; {count(found.skipped_ticks, 'tick')} skipped",
        "wake-up after the due time",
    )
    link = SummaryRow(
        "Link",
        f"{count(found.lost_pairs, 'pair')} lost, {count(found.slips, 'slip')}, delay {delay}",
        found.link,
    )
    # With a stepped clock nothing is ever late.
    return [punctuality, link] if found.wake_max_ns else [link]


def _microseconds(ns: int) -> str:
    return quantity(float(ns), "µs", 1e-3)


def _end(s: Summary) -> str:
    words = [s.end_reason, f"after {s.duration_s:.2f} s", f"state {s.final_state}"]
    if s.live is not None:
        from rthyb_rt.lab.end_reasons import in_words

        cause = in_words(s.live.cause)
        if cause not in s.end_reason:
            words.append(f"cause {cause}")
    if s.interrupted:
        words.insert(1, "interrupted")
    return ", ".join(words)


def _alpha(s: Summary) -> str:
    if not s.setup.plc_enabled:
        return "no compensation"
    text = delay(s.alpha_end, s.fs_hz)
    return text if s.setup.estimator_enabled else f"{text}, fixed"


def _samples(s: Summary) -> str:
    flagged = [
        f"{n} {name.replace('_', ' ')}" for name, n in s.flags.items() if n and name != "fresh"
    ]
    if s.skipped_ticks:
        flagged.append(f"{count(s.skipped_ticks, 'tick')} skipped")
    # With ramps and rest there are more rows than those that are judged.
    rows = f"{s.samples}" if s.samples == s.test_samples else f"{s.test_samples} of {s.samples}"
    return f"{rows}, " + (", ".join(flagged) if flagged else "none flagged")
