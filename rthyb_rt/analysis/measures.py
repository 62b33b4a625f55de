"""Measures of how well a hybrid test went: errors, delay, tracking indicator, energy error.

Every function takes one-dimensional arrays of equal length, sampled at the same instants, and
returns fractions and SI units; per cent and millimetres are for display and converted elsewhere.
Rows in which either signal is not finite are ignored.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def _paired(wanted: ArrayLike, got: ArrayLike) -> tuple[Floats, Floats]:
    """Return both signals without the rows in which one of them is not finite."""
    a, b = _same_shape(wanted, got)
    finite = np.isfinite(a) & np.isfinite(b)
    return a[finite], b[finite]


def _same_shape(*signals: ArrayLike) -> tuple[Floats, ...]:
    arrays = tuple(np.asarray(signal, dtype=np.float64) for signal in signals)
    shapes = {array.shape for array in arrays}
    if len(shapes) != 1 or arrays[0].ndim != 1:
        found = ", ".join(str(array.shape) for array in arrays)
        raise ValueError(
            f"signals must be one-dimensional and of equal length; found shapes {found}"
        )
    return arrays


def _not_finite_is_expected() -> np.errstate:
    """Suppress warnings: a diverged recording overflows, and such steps are left out anyway."""
    return np.errstate(over="ignore", invalid="ignore")


def _ratio(numerator: float, denominator: float) -> float:
    return numerator / denominator if denominator > 0.0 else float("nan")


def rms(x: ArrayLike) -> float:
    """Return the root mean square of ``x`` (mean not removed), nan for an empty array.

    The values are scaled by the largest first, because a diverged test may contain 1e200.
    """
    values = np.asarray(x, dtype=np.float64)
    if values.size == 0:
        return float("nan")
    largest = float(np.max(np.abs(values)))
    if largest == 0.0 or not np.isfinite(largest):
        return largest
    return largest * float(np.sqrt(np.mean(np.square(values / largest))))


def _nrmse(wanted: ArrayLike, got: ArrayLike) -> float:
    a, b = _paired(wanted, got)
    return _ratio(rms(b - a), rms(a))


def tracking_nrmse(x_num_m: ArrayLike, x_meas_m: ArrayLike) -> float:
    """Return the tracking error ``rms(x_m - x_c) / rms(x_c)`` as a fraction, mean not removed.

    Args:
        x_num_m: command of the integration, x_c, m.
        x_meas_m: measured displacement, x_m, m.

    Returns:
        The fraction; nan if the command is always zero.
    """
    return _nrmse(x_num_m, x_meas_m)


def response_nrmse(x_ref_m: ArrayLike, x_meas_m: ArrayLike) -> float:
    """Return the response error ``rms(x_m - x_exact) / rms(x_exact)``, mean not removed.

    It must be read together with the tracking error: force compensation with the exact stiffness
    gives the right response even if the specimen does not move.

    Args:
        x_ref_m: reference simulation, x_exact, m.
        x_meas_m: measured displacement, x_m, m.

    Returns:
        The fraction; nan if the reference is always zero.
    """
    return _nrmse(x_ref_m, x_meas_m)


def peak_difference(wanted: ArrayLike, got: ArrayLike) -> float:
    """Return ``max |got - wanted|`` in the unit of the signals, nan if no row is finite."""
    a, b = _paired(wanted, got)
    return float(np.max(np.abs(b - a))) if a.size else float("nan")


def peak_error(wanted: ArrayLike, got: ArrayLike) -> float:
    """Return ``max |got - wanted| / max |wanted|`` as a fraction, nan when ``wanted`` is zero."""
    a, b = _paired(wanted, got)
    if a.size == 0:
        return float("nan")
    return _ratio(float(np.max(np.abs(b - a))), float(np.max(np.abs(a))))


def accumulated_error(x_ref_m: ArrayLike, x_meas_m: ArrayLike) -> Floats:
    """Return the accumulated error of Eqn 4.3 of Chen & Tsai (2012) up to each row, m.

    ``Error_ac[n] = sum_{i<=n} abs(x_m[i] - x_exact[i])``. It is a sum over samples, not an
    integral over time, so tests can only be compared at the same sampling rate.

    Args:
        x_ref_m: reference simulation, x_exact, shape (n,), m.
        x_meas_m: measured displacement, x_m, shape (n,), m.

    Returns:
        Running sum, shape (n,), m. A row that is not finite adds nothing.
    """
    a, b = _same_shape(x_ref_m, x_meas_m)
    with _not_finite_is_expected():
        difference = np.abs(b - a)
        return np.cumsum(np.where(np.isfinite(difference), difference, 0.0))


class Fei(NamedTuple):
    """Frequency evaluation index: the actuator represented by one gain and one delay.

    Attributes:
        amplitude: |FEI|; ideally 1; below 1 the specimen moves too little.
        delay_s: equivalent delay, s; positive if the measured displacement lags.
        f_eq_hz: equivalent frequency to which both apply, Hz.
    """

    amplitude: float
    delay_s: float
    f_eq_hz: float


def fei(x_num_m: ArrayLike, x_meas_m: ArrayLike, fs_hz: float, power: float = 2.0) -> Fei:
    """Return gain and delay of the actuator by the frequency evaluation index.

    With the spectra X_c(f_j) and X_m(f_j), j = 1 ... N/2,

        FEI  = sum_j [X_m/X_c] |X_c|^l / sum_j |X_c|^l
        f_eq = sum_j f_j |X_c|^l / sum_j |X_c|^l
        A    = |FEI|,   delay = -arg(FEI) / (2 pi f_eq)

    Guo, T., Chen, C., Xu, W., Sanchez, F.: "A frequency response analysis approach for
    quantitative assessment of actuator tracking for real-time hybrid simulation", Smart Materials
    and Structures 23 (2014) 045042; also in "Hybrid simulation current assessment measures"
    (Riascos, Ou, Dyke 2014). The mean (j = 0) is left out: it has no phase.

    Args:
        x_num_m: command of the integration, shape (n,), m.
        x_meas_m: measured displacement, shape (n,), m.
        fs_hz: sampling rate, Hz.
        power: the exponent l; 2, the authors' choice, weights by energy.

    Returns:
        Amplitude, delay and equivalent frequency; all nan if the command has no content. The
        delay is unambiguous up to half a period of f_eq.
    """
    x_c, x_m = _same_shape(x_num_m, x_meas_m)
    unknown = Fei(float("nan"), float("nan"), float("nan"))
    known = np.flatnonzero(np.isfinite(x_c) & np.isfinite(x_m))
    scale = float(np.max(np.abs(x_c[known]), initial=0.0))
    if known.size < 3 or scale == 0.0:
        return unknown
    if known.size < x_c.size:
        # Linear interpolation of the same gaps in both keeps their phase; removing rows would not.
        rows = np.arange(x_c.size)
        x_c, x_m = np.interp(rows, known, x_c[known]), np.interp(rows, known, x_m[known])
    spectrum_c = np.fft.rfft(x_c / scale)[1:]
    spectrum_m = np.fft.rfft(x_m / scale)[1:]
    magnitude = np.abs(spectrum_c)
    # Prevents division of round-off by round-off in an empty bin.
    used = magnitude > 1e-12 * np.max(magnitude, initial=0.0)
    if not np.any(used):
        return unknown
    weight = magnitude[used] ** power
    weight /= np.sum(weight)
    frequency_hz = np.fft.rfftfreq(x_c.size, 1.0 / fs_hz)[1:][used]
    index = complex(np.sum(weight * spectrum_m[used] / spectrum_c[used]))
    f_eq_hz = float(np.sum(weight * frequency_hz))
    delay_s = -float(np.angle(index)) / (2.0 * np.pi * f_eq_hz)
    return Fei(abs(index), delay_s, f_eq_hz)


def tracking_indicator(x_num_m: ArrayLike, x_meas_m: ArrayLike) -> Floats:
    """Return the tracking indicator up to each row, m^2.

    Half the difference of the areas that the trajectory (x_c, x_m) encloses with its two axes,

        TI[n] = TI[n-1] + 1/2 { 1/2 (x_m[n] + x_m[n-1]) (x_c[n] - x_c[n-1])
                              - 1/2 (x_c[n] + x_c[n-1]) (x_m[n] - x_m[n-1]) }

    Mercan, O., Ricles, J.M.: "Stability and accuracy analysis of outer loop dynamics in real-time
    pseudodynamic testing of SDOF systems", Earthquake Engineering & Structural Dynamics 36 (2007)
    1523-1543. A falling TI means that the specimen lags (energy is fed into the structure), a
    rising one that it leads. A sine of amplitude A with phase lag p loses pi A^2 sin p per cycle;
    an amplitude error alone leaves TI at zero.

    Args:
        x_num_m: command of the integration, x_c, shape (n,), m.
        x_meas_m: measured displacement, x_m, shape (n,), m.

    Returns:
        Running sum, shape (n,), m^2, first value 0. A step that is not finite adds nothing.
    """
    x_c, x_m = _same_shape(x_num_m, x_meas_m)
    with _not_finite_is_expected():
        area_c = 0.5 * (x_m[1:] + x_m[:-1]) * np.diff(x_c)
        area_m = 0.5 * (x_c[1:] + x_c[:-1]) * np.diff(x_m)
        return _running_sum(0.5 * (area_c - area_m), x_c.size)


def energy_error(f_meas_n: ArrayLike, x_num_m: ArrayLike, x_meas_m: ArrayLike) -> Floats:
    """Return the energy that the tracking error has fed into the structure up to each row, J.

    Work of the measured force along the measured displacement minus that along the command,

        E[n] = E[n-1] + 1/2 (f[n] + f[n-1]) { (x_m - x_c)[n] - (x_m - x_c)[n-1] }

    Mosqueda, G., Stojadinovic, B., Mahin, S.A.: "Real-time error monitoring for hybrid simulation.
    Part I: methodology and experimental verification", Journal of Structural Engineering 133
    (2007) 1100-1108. Positive: a lagging actuator feeds energy in (negative damping); negative:
    a leading one removes energy. A spring k and a sine of amplitude A with phase lag p gain
    k pi A^2 sin p per cycle.

    Args:
        f_meas_n: measured force, shape (n,), N.
        x_num_m: command of the integration, x_c, shape (n,), m.
        x_meas_m: measured displacement, x_m, shape (n,), m.

    Returns:
        Running sum, shape (n,), J, first value 0. A step that is not finite adds nothing.
    """
    f, x_c, x_m = _same_shape(f_meas_n, x_num_m, x_meas_m)
    with _not_finite_is_expected():
        return _running_sum(0.5 * (f[1:] + f[:-1]) * np.diff(x_m - x_c), f.size)


def fed_energy(
    f_meas_n: ArrayLike,
    x_num_m: ArrayLike,
    x_meas_m: ArrayLike,
    k_t_n_per_m: ArrayLike,
    k_e_n_per_m: float,
) -> Floats:
    """Return the energy that the tracking error has fed into the equation of motion, J.

    The equation of motion uses F = f + k_t (x_c - x_m) (Eqn 3.2) along x_c, the specimen is
    subjected to f along x_m. The difference of both works was fed in, except for what is merely
    stored, the strain energy f^2 / (2 k_e):

        E[n] = integral f dx_m - integral F dx_c - (f^2 - F^2) / (2 k_e)

    Without force compensation (k_t = 0) F is f, and this is `energy_error`, the hybrid simulation
    error of Mosqueda et al. (2007). With it, the energy error also counts what the compensation has
    removed: with the exact stiffness nothing is fed, whatever the delay. Positive is negative
    damping: a delay d of a spring k acts as the damping -k d (Horiuchi, T., Inoue, M., Konno, T.,
    Namita, Y.: "Real-time hybrid experimental system with actuator delay compensation and its
    application to a piping system with energy absorber", Earthquake Engineering & Structural
    Dynamics 28 (1999) 1121-1141).

    Args:
        f_meas_n: measured force, shape (n,), N.
        x_num_m: command of the integration, x_c, shape (n,), m.
        x_meas_m: measured displacement, x_m, shape (n,), m.
        k_t_n_per_m: tangent stiffness of the force compensation, 0 where it is off, shape (n,).
        k_e_n_per_m: elastic stiffness; with 0, stored energy counts as fed.

    Returns:
        Running sum, shape (n,), J, first value 0. A step that is not finite adds nothing.
    """
    f, x_c, x_m, k_t = _same_shape(f_meas_n, x_num_m, x_meas_m, k_t_n_per_m)
    with _not_finite_is_expected():
        used = f + k_t * (x_c - x_m)
        steps = 0.5 * (f[1:] + f[:-1]) * np.diff(x_m) - 0.5 * (used[1:] + used[:-1]) * np.diff(x_c)
        if k_e_n_per_m > 0.0:
            steps -= np.diff((f - used) * (f + used)) / (2.0 * k_e_n_per_m)
        return _running_sum(steps, f.size)


def damping_energy(x_num_m: ArrayLike, damping_n_s_per_m: float, fs_hz: float) -> Floats:
    """Return the energy dissipated by the numerical damping up to each row, J.

    ``integral c v^2 dt`` with the velocity between two rows.

    Args:
        x_num_m: command of the integration, x_c, shape (n,), m.
        damping_n_s_per_m: damping of the numerical part, N s/m.
        fs_hz: sampling rate, Hz.

    Returns:
        Running sum, shape (n,), J, first value 0. A step that is not finite adds nothing.
    """
    (x_c,) = _same_shape(x_num_m)
    with _not_finite_is_expected():
        return _running_sum(damping_n_s_per_m * fs_hz * np.square(np.diff(x_c)), x_c.size)


def input_energy(ag_mps2: ArrayLike, x_num_m: ArrayLike, mass_kg: float) -> Floats:
    """Return the energy supplied to the structure by the ground motion up to each row, J.

    Relative form: ``E_I = -integral m a_g dx_c``, trapezoidal in a_g.

    Args:
        ag_mps2: ground acceleration, shape (n,), m/s^2.
        x_num_m: displacement relative to the ground, shape (n,), m.
        mass_kg: mass of the structure, kg.

    Returns:
        Running sum, shape (n,), J, first value 0. A step that is not finite adds nothing.
    """
    ag, x_c = _same_shape(ag_mps2, x_num_m)
    with _not_finite_is_expected():
        return _running_sum(-0.5 * mass_kg * (ag[1:] + ag[:-1]) * np.diff(x_c), ag.size)


def hsem(
    energy_error_j: ArrayLike,
    input_energy_j: ArrayLike | None,
    f_meas_n: ArrayLike,
    k_e_n_per_m: float,
) -> float:
    """Return the greatest energy error as a fraction of the energy in the test.

    ``max |E_error| / (max E_input + max E_strain)`` with ``E_strain = f^2 / (2 k_e)``, the
    recoverable strain energy of the specimen. It follows the hybrid simulation error monitor of
    Mosqueda et al. (2007), but with the greatest input energy of the whole test in the denominator,
    because the running one may pass zero in a test that diverges.

    Args:
        energy_error_j: from `energy_error`, shape (n,), J.
        input_energy_j: from `input_energy`, shape (n,), J; None if the mass is not known.
        f_meas_n: measured force, shape (n,), N.
        k_e_n_per_m: elastic stiffness of the specimen, N/m.

    Returns:
        The fraction; nan if there is no energy in the test.
    """
    force = np.asarray(f_meas_n, dtype=np.float64)
    largest_force = float(np.max(np.abs(force[np.isfinite(force)]), initial=0.0))
    # A product overflows to inf, whereas a power would raise an exception.
    energy = largest_force * (largest_force / (2.0 * k_e_n_per_m))
    if input_energy_j is not None:
        energy += float(np.max(np.asarray(input_energy_j, dtype=np.float64), initial=0.0))
    error = float(np.max(np.abs(np.asarray(energy_error_j, dtype=np.float64)), initial=0.0))
    return _ratio(error, energy)


def _running_sum(steps: Floats, rows: int) -> Floats:
    total = np.zeros(rows)
    np.cumsum(np.where(np.isfinite(steps), steps, 0.0), out=total[1:])
    return total
