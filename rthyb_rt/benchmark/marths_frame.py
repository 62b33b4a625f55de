"""The multi-axial benchmark: its frames, its plant and its coupler.

A steel frame of three storeys, with one bay of the first storey in the laboratory: two actuators
move its upper right joint by a coupler, in translation and rotation. Reference structure, the
subtracted bay, the frame model that provides the forces, and the plant with its perturbations are
reimplemented from the benchmark's own code (github.com/FermandoisLab/maRTHS-bmk-RoDeAC at eb0f21b,
MIT); ``docs/benchmark-marths.md`` describes its peculiarities. Degrees of freedom are counted from
0; SI units throughout, also for the plant.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.coupled_plant import CoupledPlantConfig
from rthyb_rt.core.kinematics import Kinematics, Pin
from rthyb_rt.core.numerical_parts import SparsePart
from rthyb_rt.core.sparse import SparseConfig, Symmetric

Floats = NDArray[np.float64]

RATE_HZ: Final = 1024
PERIOD_S: Final = 1.0 / RATE_HZ

X, TURN, OTHER_TURN = 26, 20, 28
"""Degrees of freedom of the interface: displacement, rotation of the joint at the coupler, and of
the joint across the beam. The laboratory's rotations have the opposite sign."""
UPPER: Final = {"x2": 25, "theta2": 21, "x3": 12, "theta3": 2}
"""Displacement and rotation of storeys 2 and 3 that the criteria use."""
SHAKEN: Final = (26, 25, 12)
"""Degrees of freedom on which the ground motion acts."""
INTERFACE: Final = (X, OTHER_TURN, TURN)

_INCH: Final = 0.0254
_E_PA: Final = 200e9
_COLUMN_I: Final = 2.520 * _INCH**4
_COLUMN_A: Final = 1.670 * _INCH**2
_BEAM_M: Final = 0.762


@dataclass(frozen=True, eq=False)
class FrameStructure:
    """M x'' + C x' + K x = -M l ag, with n degrees of freedom, some of them without mass.

    Attributes:
        mass, damping, stiffness: (n, n).
        influence: l, (n,).
        load: M l, kg, (n,).
    """

    mass: Floats
    damping: Floats
    stiffness: Floats
    influence: Floats

    @property
    def load(self) -> Floats:
        """Force for a ground acceleration of -1 m/s^2, (n,)."""
        return np.asarray(self.mass @ self.influence)


def _read(name: str) -> Floats:
    text = (resources.files("rthyb_rt") / "data" / name).read_text(encoding="utf-8")
    return np.loadtxt(text.splitlines(), delimiter=",", comments="#")


def _rayleigh(mass: Floats, stiffness: Floats, ratio: float, first: float, last: float) -> Floats:
    """Return the damping matrix with this ratio at two circular frequencies, rad/s."""
    equations = 0.5 * np.array([[1.0 / first, first], [1.0 / last, last]])
    by_mass, by_stiffness = np.linalg.solve(equations, [ratio, ratio])
    return np.asarray(by_mass * mass + by_stiffness * stiffness)


def _modes(mass: Floats, stiffness: Floats) -> tuple[Floats, Floats]:
    """Return circular frequencies, ascending, and modes of unit modal mass, for a diagonal mass."""
    root = 1.0 / np.sqrt(np.diag(mass))
    squares, vectors = np.linalg.eigh(root[:, None] * stiffness * root)
    return np.sqrt(squares), root[:, None] * vectors


@functools.cache
def reference() -> FrameStructure:
    """Return the whole frame: 29 degrees of freedom, 14 without mass; 5 % at 2.15 and 26.3 Hz."""
    mass, stiffness = _read("marths_reference_mass.csv"), _read("marths_reference_stiffness.csv")
    influence = np.zeros(len(mass))
    influence[list(SHAKEN)] = 1.0
    damping = _rayleigh(mass, stiffness, 0.05, 13.493, 165.125)
    return FrameStructure(mass, damping, stiffness, influence)


@functools.cache
def bay() -> tuple[Floats, Floats, Floats]:
    """Return M, C, K of the bay to be subtracted, by `INTERFACE`, (3, 3) each.

    Pinned feet, with their rotations condensed. Its density is 785 t/m3 in the benchmark's code, so
    that 902 kg are subtracted.
    """
    column_m, density, beam_i, beam_a = 0.635, 785e3, 0.6132 * _INCH**4, 0.947 * _INCH**2
    beam_kg, column_kg = density * beam_a * _BEAM_M, density * _COLUMN_A * column_m
    turning = (beam_kg * _BEAM_M**2 + column_kg * column_m**2) / 24.0
    mass = np.diag([beam_kg + column_kg, turning, turning])
    column, beam = 3.0 * _E_PA * _COLUMN_I / column_m**2, 2.0 * _E_PA * beam_i / _BEAM_M
    own = column * column_m + 2.0 * beam
    stiffness = np.array(
        [
            [2.0 * column / column_m, -column, -column],
            [-column, own, -beam],
            [-column, -beam, own],
        ]
    )
    frequencies, _ = _modes(mass, stiffness)
    return mass, _rayleigh(mass, stiffness, 0.05, frequencies[0], frequencies[-1]), stiffness


@functools.cache
def numerical() -> FrameStructure:
    """Return the reference less the bay, of whose mass only the part for x is subtracted."""
    whole, (mass, damping, stiffness) = reference(), bay()
    where = np.ix_(INTERFACE, INTERFACE)
    m, c, k = whole.mass.copy(), whole.damping.copy(), whole.stiffness.copy()
    m[X, X] -= mass[0, 0]
    c[where] -= damping
    k[where] -= stiffness
    return FrameStructure(m, c, k, whole.influence)


@functools.cache
def specimen() -> tuple[Floats, Floats, Floats]:
    """Return K, C, M, (3, 2) each, of the frame model that provides the forces.

    Rows are force and the moments of `TURN` and `OTHER_TURN`, columns x and the rotation at the
    coupler; the rotations of the other joint and of the feet follow statically.
    """
    column_m, density, beam_i, beam_a = 0.64135, 7850.0, 4.21372e-7, 7.56e-4
    column, beam = _E_PA * 0.7 * _COLUMN_I / column_m, _E_PA * beam_i / _BEAM_M
    side, half, own, tie = 6.0 * column / column_m, 2.0 * column, 4.0 * column, 2.0 * beam
    joint = own + 4.0 * beam
    stiffness = np.array(
        [
            [4.0 * side / column_m, side, side, side, side],
            [side, joint, tie, 0.0, half],
            [side, tie, joint, half, 0.0],
            [side, 0.0, half, own, 0.0],
            [side, half, 0.0, 0.0, own],
        ]
    )
    beam_kg, column_kg = density * beam_a * _BEAM_M, density * _COLUMN_A * column_m
    foot = 1.1 * column_kg * column_m**2 / 6.0
    top = 1.1 * beam_kg * _BEAM_M**2 / 6.0 + foot
    mass = np.diag([1.1 * (0.5 * beam_kg + column_kg), top, top, foot, foot])
    frequencies, modes = _modes(mass, stiffness)
    frequencies = np.round(100.0 * frequencies) / 100.0
    damping = mass @ modes @ np.diag(0.1 * frequencies) @ modes.T @ mass
    follows = -np.linalg.solve(stiffness[2:, 2:], stiffness[2:, :2])
    tied = np.vstack([np.eye(2), follows])
    k, c, m = ((matrix @ tied)[:3] for matrix in (stiffness, damping, mass))
    return k, c, m


TO_INTERFACE: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
"""Signs from forces of `specimen` to those along `INTERFACE`: rotations are reversed."""


@functools.cache
def joined() -> FrameStructure:
    """Return the numerical part and the frame model, solved as one."""
    part = numerical()
    m, c, k = part.mass.copy(), part.damping.copy(), part.stiffness.copy()
    pose = np.zeros((2, len(m)))
    pose[0, X], pose[1, TURN] = 1.0, -1.0
    for matrix, own in zip((k, c, m), specimen(), strict=True):
        matrix[list(INTERFACE)] += TO_INTERFACE @ own @ pose
    return _Joined(m, c, k, part.influence)


class _Joined(FrameStructure):
    """The frame in the laboratory is not on moving ground: its mass causes no load."""

    @property
    def load(self) -> Floats:
        return numerical().load


# ---- coupler and plant --------------------------------------------------------------------------

ARM_M: Final = float(np.hypot(0.26670, 0.127))
ARM_RAD: Final = float(np.radians(25.4633))


def kinematics() -> Kinematics:
    """Return x_1,2 = x + d (cos(theta -+ a) - cos a): both actuators keep their direction."""
    out, up = ARM_M * np.cos(ARM_RAD), ARM_M * np.sin(ARM_RAD)
    pins = [Pin((out, side * up), (1.0, 0.0), far=True) for side in (-1.0, 1.0)]
    return Kinematics(pins=pins, coordinates=["x", "theta"])


ROOTS: Final[Mapping[str, complex]] = {
    "zero_1a": -120.0,
    "zero_1b": -90.0,
    "pole_1a": -2.65,
    "pole_1b": -40.0,
    "frame": -50.0 + 63.0j,
    "zero_12": -3.0,
    "zero_22": -5.0,
    "pole_2a": -3.5,
    "pole_2b": -18.5,
}
"""Zeros and poles of the nominal plant in Hz; those of the frame are a pair."""

DEVIATIONS: Final = {
    "zero_1a": 0.055,
    "zero_1b": 0.055,
    "pole_1a": 0.06,
    "pole_1b": 0.06,
    "frame": 0.05,
    "zero_12": 0.03,
    "pole_2a": 0.03,
    "pole_2b": 0.03,
    "zero_22": 0.03,
}
"""Standard deviations of each root for perturbed plants; static gains remain nominal."""

GAINS: Final = {"11": 2165.2, "21": 349.95, "12": 4.5394e6, "22": 1.9238e7}
NOISE_M: Final = 1e-3 * float(np.sqrt(1.5e-7 * RATE_HZ))
STROKE_M: Final = 0.030
"""Range of a command: 3.8 V."""
FORCE_LIMIT_N: Final = 2100 * 4.44822
"""Range of an actuator's force; its load cell is limited to 11.1 kN."""
SEEDS: Final = tuple(range(8001, 8021))
"""Seeds of the perturbed plants; the benchmark requires 20."""


def roots(seed: int | None, width: float = 1.0) -> dict[str, complex]:
    """Return zeros and poles, Hz, of the nominal plant (None) or of a perturbed one.

    ``width``: factor on the stated standard deviations.
    """
    if seed is None:
        return dict(ROOTS)
    normal = np.random.default_rng(seed).normal(size=len(DEVIATIONS))
    return {
        name: ROOTS[name] * (1.0 + width * deviation * float(z))
        for (name, deviation), z in zip(DEVIATIONS.items(), normal, strict=True)
    }


def _transfer(
    zeros: tuple[str, ...], poles: tuple[str, ...], gain: float, of: Mapping[str, complex]
) -> tuple[Floats, Floats]:
    """Return numerator and denominator, highest power first, with the nominal static gain."""

    def polynomials(values: Mapping[str, complex]) -> tuple[Floats, Floats]:
        pair = [values["frame"], np.conj(values["frame"])]
        above = 2 * np.pi * np.array([values[name] for name in zeros])
        below = 2 * np.pi * np.array([*(values[name] for name in poles), *pair])
        return np.real(np.poly(above)), np.real(np.poly(below))

    (own, own_below), (nominal, nominal_below) = polynomials(of), polynomials(ROOTS)
    rest = gain * nominal[-1] / nominal_below[-1]
    return rest * own_below[-1] / own[-1] * own, own_below


def plant_matrices(seed: int | None, width: float = 1.0) -> tuple[Floats, Floats, Floats]:
    """Return A, B, C of the plant in continuous time, (8, 8), (8, 2), (2, 8), mm to mm or m to m.

    Each column of the transfer matrix has its own four poles, in controller canonical form.
    """
    of = roots(seed, width)
    first, second = ("pole_1a", "pole_1b"), ("pole_2a", "pole_2b")
    entries = {
        (0, 0): (("zero_1a", "zero_1b"), first, GAINS["11"]),
        (1, 0): (("zero_1a", "zero_1b"), first, GAINS["21"]),
        (0, 1): (("zero_12",), second, GAINS["12"]),
        (1, 1): (("zero_22",), second, GAINS["22"]),
    }
    a, b, c = np.zeros((8, 8)), np.zeros((8, 2)), np.zeros((2, 8))
    for (row, column), (zeros, poles, gain) in entries.items():
        above, below = _transfer(zeros, poles, gain, of)
        own = slice(4 * column, 4 * column + 4)
        a[own, own] = np.eye(4, k=-1)
        a[4 * column, own] = -below[1:]
        b[4 * column, column] = 1.0
        c[row, 4 * column + 4 - above.size : 4 * column + 4] = above
    return a, b, c


def plant(
    seed: int | None, noise_seed: int, noise_m: float = NOISE_M, width: float = 1.0
) -> CoupledPlantConfig:
    """Return the virtual rig with the nominal plant (None) or a perturbed one.

    Discretised like a held input in Simulink's ode4: the series of the exponential up to the fourth
    power of the sampling period.
    """
    a, b, c = plant_matrices(seed, width)
    step, power, by_input = np.eye(8), np.eye(8), np.zeros((8, 8))
    for order in range(1, 5):
        by_input = by_input + power * PERIOD_S / order
        power = power @ a * PERIOD_S / order
        step = step + power
    stiffness, damping, mass = specimen()
    return CoupledPlantConfig(
        step,
        by_input @ b,
        c,
        kinematics(),
        (STROKE_M, STROKE_M),
        (noise_m, noise_m),
        stiffness,
        damping,
        mass,
        noise_seed,
        PERIOD_S,
    )


# ---- integration --------------------------------------------------------------------------------


class Newmark:
    """Newmark's constant-acceleration method as implemented in the benchmark, at rest at 0.

    It returns the displacements for the instant at which the force was measured: the force in the
    equation of t_n is that of the specimen at the position the actuators had reached by then.
    """

    ahead = 0

    def __init__(self, structure: FrameStructure, period_s: float = PERIOD_S) -> None:
        h, n = period_s, len(structure.influence)
        whole = structure.stiffness + 4.0 / h**2 * structure.mass + 2.0 / h * structure.damping
        inverse = np.linalg.inv(whole)
        self._by_state = inverse @ np.hstack(
            [
                4.0 / h**2 * structure.mass + 2.0 / h * structure.damping,
                4.0 / h * structure.mass + structure.damping,
                structure.mass,
            ]
        )
        self._by_ground = -inverse @ structure.load
        self._by_force = -inverse[:, list(INTERFACE)]
        self._h, self._n = h, n
        self._state = np.zeros(3 * n)

    def step(self, ag_mps2: float, force: Floats | None = None) -> Floats:
        """Return the displacements, (n,), one sample later.

        Args:
            ag_mps2: ground acceleration at that sample.
            force: force of the specimen along `INTERFACE`, (3,); None: no specimen is joined.
        """
        n, h, state = self._n, self._h, self._state
        x = self._by_state @ state + self._by_ground * ag_mps2
        if force is not None:
            x += self._by_force @ force
        x0, v0, a0 = state[:n], state[n : 2 * n], state[2 * n :]
        a = 4.0 / h**2 * (x - x0) - 4.0 / h * v0 - a0
        self._state = np.concatenate([x, v0 + 0.5 * h * (a0 + a), a])
        return x

    def run(self, ag_mps2: Floats) -> Floats:
        """Return the displacements, (samples, n), of a structure simulated as a whole."""
        return np.array([self.step(float(ag)) for ag in ag_mps2])


class KrAlpha:
    """This program's numerical part: KR-alpha with one sparse solve per step, in C, at rest at 0.

    It returns the displacements for the next instant. Its estimate of the specimen is the stiffness
    of the subtracted bay along the directions of that matrix. The rotations at the interface have
    no mass: noise of the force near half the sample rate persists in them, the longer the closer
    ``rho_inf`` is to 1.
    """

    ahead = 1

    def __init__(self, structure: FrameStructure, rho_inf: float = 0.5) -> None:
        stiffness, self._directions = np.linalg.eigh(bay()[2])
        rows = tuple(
            tuple((at, float(weight)) for at, weight in zip(INTERFACE, direction, strict=True))
            for direction in self._directions.T
        )
        self._part = SparsePart(
            SparseConfig(
                Symmetric.of(structure.mass),
                Symmetric.of(structure.stiffness),
                structure.load,
                rows,
                tuple(float(k) for k in stiffness),
                damping_n_s_per_m=Symmetric.of(structure.damping),
                rho_inf=rho_inf,
                period_s=PERIOD_S,
            )
        )

    def step(self, ag_mps2: float, force: Floats) -> Floats:
        """Return displacements, (n,), one sample after a ground acceleration and force, (3,)."""
        self._part.answer_all(ag_mps2, (self._directions.T @ force).tolist())
        self._part.advance()
        return self._part.displacements()
