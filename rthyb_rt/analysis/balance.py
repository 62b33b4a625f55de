"""Energy balance of a test: input, kinetic, strain, damping, specimen.

The equation of motion in relative coordinates, m a + c v + k x + F = -m a_g, is multiplied by the
velocity and integrated over time. F = f + k_t (x_c - x_m) is the force used by the integration
(Eqn 3.2), f the measured force:

    E_input + E_fed = E_kinetic + E_damping + E_strain + E_specimen

E_fed is the energy fed in by the tracking error (`measures.fed_energy`). The balance of a structure
without an actuator is given by Uang, C.-M., Bertero, V.V.: "Evaluation of seismic energy in
structures", Earthquake Engineering & Structural Dynamics 19 (1990) 77-90.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import documents
from rthyb_rt.analysis import measures
from rthyb_rt.config.testfile import PRESCRIBED

if TYPE_CHECKING:
    from rthyb_rt.analysis.summary import SummarySettings
    from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class EnergyBalance:
    """Energies up to each row of the test proper, (n,), J.

    Attributes:
        t_s: time of the rows, (n,), s.
        input_j: supplied by the ground motion.
        fed_j: fed in by the tracking error; negative: removed by it.
        kinetic_j, damping_j: of the numerical part: in its motion, and dissipated by its damping.
        strain_j: recoverable: in the numerical stiffness and in the elastic specimen.
        specimen_j: dissipated by the specimen: hysteresis, friction, its own damping.
        elements_j: dissipated by nonlinear elements of the numerical part.
    """

    t_s: Floats
    input_j: Floats
    fed_j: Floats
    kinetic_j: Floats
    damping_j: Floats
    strain_j: Floats
    specimen_j: Floats
    elements_j: Floats

    def __repr__(self) -> str:
        """Return what the specimen and the damping dissipated of the input, in one line."""
        if not self.t_s.size:
            return "<EnergyBalance of 0 rows>"
        parts = ("input", "fed", "kinetic", "damping", "strain", "specimen", "elements")
        ends = ", ".join(f"{name} {getattr(self, f'{name}_j')[-1]:.4g} J" for name in parts)
        return f"<EnergyBalance of {self.t_s.size} rows, at the end: {ends}; gap {self.gap:.2g}>"

    @property
    def rest_j(self) -> Floats:
        """Residual of the balance: discretisation, and the filter of the force compensation."""
        kept = self.kinetic_j + self.damping_j + self.strain_j
        return np.asarray(self.input_j + self.fed_j - kept - self.specimen_j - self.elements_j)

    @property
    def gap(self) -> float:
        """Greatest residual over the greatest input and strain energy; nan if there is none."""
        whole = float(np.max(self.input_j, initial=0.0) + np.max(self.strain_j, initial=0.0))
        return float(np.max(np.abs(self.rest_j), initial=0.0)) / whole if whole else float("nan")


def of_recording(rec: RecordedTest, given: SummarySettings) -> EnergyBalance | None:
    """Return the balance of a recording; None if mass, damping or stiffness are not known.

    A structure with many degrees of freedom is handled by `structure_balance`. Only rows up to the
    first interruption of the test proper are used.

    Args:
        rec: the recording.
        given: settings from its files.
    """
    test = documents.toml_if_valid(rec.test_toml)
    about = test.get("test")
    if isinstance(about, dict) and about.get("description") == PRESCRIBED:
        return None
    numerical = test.get("numerical", {})
    # What a user's own part does with its energy is not known here.
    if not isinstance(numerical, dict) or numerical.keys() & {"library", "fmu", "python"}:
        return None
    if any(key in numerical for key in ("matrices", "storeys")):
        # Imported here: a test of one mass does not need the packages for structures.
        from rthyb_rt.analysis import structure_balance

        return structure_balance.of_recording(rec)
    known = (given.mass_kg, given.damping_n_s_per_m, given.k_e_n_per_m)
    rows = uninterrupted(rec)
    if rows.size < 3 or any(value is None for value in known):
        return None
    s = rec.samples[rows]
    signals = [
        np.where(np.isfinite(s[name]), s[name], 0.0)
        for name in ("x_num_m", "x_meas_m", "f_meas_n", "ag_mps2", "k_t_n_per_m")
    ]
    stiffness = numerical.get("stiffness_n_per_m", 0.0)
    k = float(stiffness) if isinstance(stiffness, (int, float)) else 0.0
    mass, damping, k_e = (float(value or 0.0) for value in known)
    return balance(
        rec.time_s()[rows], *signals, mass_kg=mass, damping_n_s_per_m=damping,
        stiffness_n_per_m=k, k_e_n_per_m=k_e, fs_hz=rec.fs_hz, compensated=given.rfc_enabled,
    )  # fmt: skip


def uninterrupted(rec: RecordedTest) -> NDArray[np.intp]:
    """Return the row numbers of the test proper up to its first interruption."""
    rows = np.flatnonzero(rec.running())
    breaks = np.flatnonzero(np.diff(rows) > 1)
    return rows[: breaks[0] + 1] if breaks.size else rows


def balance(
    t_s: Floats, x_num_m: Floats, x_meas_m: Floats, f_meas_n: Floats, ag_mps2: Floats,
    k_t_n_per_m: Floats, *, mass_kg: float, damping_n_s_per_m: float, stiffness_n_per_m: float,
    k_e_n_per_m: float, fs_hz: float, compensated: bool = True,
) -> EnergyBalance:  # fmt: skip
    """Return the energies of a structure with one degree of freedom.

    Args:
        t_s: time, (n,), s.
        x_num_m, x_meas_m: command of the integration and measured displacement, (n,), m.
        f_meas_n: measured force, (n,), N.
        ag_mps2: ground acceleration, (n,), m/s^2.
        k_t_n_per_m: tangent stiffness of the force compensation, (n,), N/m.
        mass_kg, damping_n_s_per_m, stiffness_n_per_m: of the numerical part.
        k_e_n_per_m: elastic stiffness of the specimen, N/m.
        fs_hz: sampling rate, Hz.
        compensated: whether the force was compensated.
    """
    k_t = k_t_n_per_m if compensated else np.zeros_like(k_t_n_per_m)
    with np.errstate(over="ignore", invalid="ignore"):
        used = f_meas_n + k_t * (x_num_m - x_meas_m)
        v = np.gradient(x_num_m) * fs_hz
        elastic = used * (used / (2.0 * k_e_n_per_m))
        stored = f_meas_n * (f_meas_n / (2.0 * k_e_n_per_m))
        taken = np.zeros_like(f_meas_n)
        work = 0.5 * (f_meas_n[1:] + f_meas_n[:-1]) * np.diff(x_meas_m)
        taken[1:] = np.cumsum(np.where(np.isfinite(work), work, 0.0))
        found = {
            "input_j": measures.input_energy(ag_mps2, x_num_m, mass_kg),
            "fed_j": measures.fed_energy(f_meas_n, x_num_m, x_meas_m, k_t, k_e_n_per_m),
            "kinetic_j": 0.5 * mass_kg * v * v,
            "damping_j": measures.damping_energy(x_num_m, damping_n_s_per_m, fs_hz),
            "strain_j": 0.5 * stiffness_n_per_m * x_num_m * x_num_m + elastic,
            "specimen_j": taken - stored,
            "elements_j": np.zeros_like(f_meas_n),
        }
        # A test begins at rest: any offset at its beginning does not belong to it.
        return EnergyBalance(t_s, **{name: value - value[0] for name, value in found.items()})
