"""A structure of many degrees of freedom and its specimen, built from the test file's keys."""

from __future__ import annotations

import functools
import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt import core
from rthyb_rt.config import matrixfile, timescale
from rthyb_rt.config.dof_units import DofUnits
from rthyb_rt.config.fields import nearest, written
from rthyb_rt.config.numerical_structure import Mode, linear_and_others
from rthyb_rt.config.own_tables import core_element
from rthyb_rt.config.rigfile import FRICTION_WIDTH_MAX
from rthyb_rt.config.structures import (
    Damping,
    Interface,
    MatrixFile,
    Nonlinear,
    Storeys,
)
from rthyb_rt.core import CoreError, ElementConfig
from rthyb_rt.core.library import LibraryMissing
from rthyb_rt.core.numerical_parts import SparsePart
from rthyb_rt.core.sparse import (
    GROUND,
    SLIDERS_MAX,
    Joint,
    Response,
    SparseConfig,
    SparseIntegrator,
    Symmetric,
    Term,
    factored,
    initial_stiffness,
    least_restrained,
    lowest_modes,
)
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]
Rows = Sequence[Sequence[float]]

SHOWN_MODES: Final = 10
GRAVITY_M_PER_S2: Final = 9.80665
DEFAULT_RECORDED: Final = 10
"""Number of storeys up to which drifts and shears are recorded if the file gives no ``record``."""
_CLEARLY: Final = 0.5
"""Share of the largest entry from which on a degree of freedom is named as part of a motion."""
_TRANSLATIONS: Final = ("x", "y", "z")
ROTATIONS: Final = ("rx", "ry", "rz")
"""Ends of labels, "7.rz", as `rthyb import-opensees` writes them."""
_ROUNDING: Final = 1e-12
"""Share of a mode's kinetic energy below which a motion is rounding: one millionth in amplitude."""
_KEPT_REFERENCES: Final = 2
_NAMED: Final = 5
"""Number of degrees of freedom that a message names."""
_DIFFERENCE: Final = re.compile(r"(.+?)\s+-\s+(.+)")
_FLOORS: Final = re.compile(r"x_([1-9]\d{0,2}) - x_([1-9]\d{0,2})")


@dataclass(frozen=True, eq=False)
class SparseStructure:
    """A numerical part of any size and what is known of its specimen.

    Attributes:
        labels: labels of the degrees of freedom, (n,).
        part: settings of the part for the core.
        influence: displacements for a unit displacement of the ground, (n,).
        specimen_mass_kg: subtracted from the masses, because it is present in the laboratory.
        interfaces: names of what the actuators move, one per interface of the part.
        heights_m: heights of the floors above the ground, (count,); empty: no storeys.
        directions: displacements for a unit displacement of the ground along each direction that
            the file of matrices names, (n,) each.
    """

    labels: tuple[str, ...]
    part: SparseConfig
    influence: Floats
    specimen_mass_kg: float = 0.0
    interfaces: tuple[str, ...] = ("x",)
    heights_m: tuple[float, ...] = ()
    directions: Mapping[str, Floats] = field(default_factory=dict)

    def slowed(self, time_scale: float) -> SparseStructure:
        """Return the structure for a slower time scale, see `rthyb_rt.config.timescale`.

        The specimen's mass is in the laboratory and is not scaled: the difference is computed, and
        `with_lack` removes it again.
        """
        if time_scale == 1.0:
            return self
        part, to_m, to_c = self.part, time_scale**2, time_scale
        c, modal = part.damping_n_s_per_m, part.modal
        slow = replace(
            part,
            mass_kg=_times(part.mass_kg, to_m),
            load_kg=to_m * part.load_kg,
            damping_n_s_per_m=None if c is None else _times(c, to_c),
            by_mass_per_s=part.by_mass_per_s / to_c,
            by_stiffness_s=to_c * part.by_stiffness_s,
            modal=None if modal is None else math.sqrt(to_c) * modal,
            joints=tuple(
                replace(joint, element=timescale.slowed(joint.element, time_scale))
                for joint in part.joints
            ),
        )
        return replace(self, part=slow).with_lack(time_scale, 1.0)

    def with_lack(self, time_scale: float, share: float) -> SparseStructure:
        """Return the structure with a share of the slow specimen's missing inertia added."""
        mass = share * (time_scale**2 - 1.0) * self.specimen_mass_kg
        if mass == 0.0:
            return self
        # Rayleigh damping still refers to the same mass.
        return replace(self, part=_with(self.part, mass, -self.part.by_mass_per_s * mass, 0.0))

    def friction_note(self) -> str | None:
        """Return the note on dry friction that is too steep and cannot be solved with the step."""
        count = len(self.part.with_dry_friction())
        if count <= SLIDERS_MAX:
            return None
        at, steep = self.part.steepest_friction()
        if steep <= 1.0:
            return None
        return (
            f"found {count} elements of numerical.nonlinear with dry friction; up to {SLIDERS_MAX} "
            "are solved for together with the step, more are evaluated at the previous velocity. "
            f"Between {self._ends(at)}, the friction is then {steep:.2g} times too steep (force / "
            "width x step / mass): it changes its sign at every sample, which a control law for a "
            f"late actuator amplifies. Use at most {SLIDERS_MAX} of them, or "
            f"{_less_steep(self.part.joints[at].element, steep)}"
        )

    def _ends(self, joint: int) -> str:
        found = self.part.joints[joint]
        below, above = (
            "the ground" if at == GROUND else written(self.labels[at])
            for at in (found.below, found.above)
        )
        return f"{below} and {above}"

    @functools.cached_property
    def joined(self) -> SparseConfig:
        """The part with the specimen's mass at the interface."""
        return _with(self.part, self.specimen_mass_kg, 0.0, 0.0)

    @functools.cached_property
    def _modes(self) -> tuple[Mode, ...]:
        w2, shapes = lowest_modes(self.joined, SHOWN_MODES)
        damping = np.einsum("ij,ij->j", shapes, self.joined.damping_times(shapes))
        row = self.joined.interface_rows()[0]
        moved = shapes.T @ self.part.load_kg
        whole = float(self.influence @ self.part.load_kg)
        inertia = shapes * (self.joined.mass_kg.matrix() @ shapes)
        found = []
        for i, square in enumerate(w2):
            omega, shape = math.sqrt(square), shapes[:, i]
            at = self._scaled_by(inertia[:, i])
            largest = shape[at][np.argmax(np.abs(shape[at]))] or 1.0
            found.append(
                Mode(
                    omega / (2.0 * math.pi),
                    float(damping[i]) / (2.0 * omega),
                    tuple(float(v) for v in shape / largest),
                    float(row @ shape),
                    float(moved[i] ** 2) / whole if whole else 0.0,
                )
            )
        return tuple(found)

    def _scaled_by(self, inertia: Floats) -> NDArray[np.intp]:
        """Return the degrees of freedom whose largest entry is the scale of a mode shape.

        These are the translations, because a rotation in rad is not a displacement in m; in a mode
        without translation, all.

        Args:
            inertia: phi * (M phi) for phi' M phi = 1, (n,).
        """
        if self.translations.size and abs(inertia[self.translations].sum()) > _ROUNDING:
            return self.translations
        return np.arange(inertia.size)

    @functools.cached_property
    def along(self) -> dict[str, NDArray[np.intp]]:
        """Degrees of freedom by what they are: x, y, z, rx, ry, rz as the end of their label says.

        Without such a label, they belong to the first direction of the file that moves them; those
        that no direction moves have no name, "".
        """
        found: dict[str, list[int]] = {}
        for i, label in enumerate(self.labels):
            way = label.rpartition(".")[2] if "." in label else ""
            if way not in _TRANSLATIONS + ROTATIONS:
                way = next((name for name, by in self.directions.items() if by[i]), "")
            found.setdefault(way, []).append(i)
        return {way: np.array(at) for way, at in found.items()}

    @functools.cached_property
    def translations(self) -> NDArray[np.intp]:
        """Degrees of freedom that are displacements, as far as labels and directions tell."""
        turning = [at for way, at in self.along.items() if way in ROTATIONS]
        named = [at for way, at in self.along.items() if way and way not in ROTATIONS]
        moved = np.flatnonzero(self.influence)
        return np.setdiff1d(np.concatenate([moved, *named]), np.concatenate([[], *turning]))

    def modes(self) -> tuple[Mode, ...]:
        """Return the lowest modes of the complete structure, at most `SHOWN_MODES`."""
        return self._modes

    def first(self) -> Mode:
        """Return the mode with the largest participation in the ground motion."""
        return max(self.modes(), key=lambda mode: mode.effective_mass)

    def reference(
        self, elements: Sequence[ElementConfig], ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats]:
        """Simulate the structure joined to a specimen model; return the interface's motion."""
        return self.whole_reference(elements, ag_mps2)[:3]

    def whole_reference(
        self, elements: Sequence[ElementConfig], ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Simulate the structure joined to a model of the specimen.

        The linear elements of the model are added to the matrices, so their forces are not delayed.

        Args:
            elements: the model.
            ag_mps2: ground acceleration at every sample, (n,).

        Returns:
            At the interface: displacement, velocity, and the force without that of the model's
            masses and dampers, (n,) each; then the responses by name, (n, responses). In responses
            that contain the specimen's force, it is that of the model's nonlinear elements only.
        """
        ag = np.atleast_1d(np.asarray(ag_mps2, dtype=np.float64))
        linear, others = linear_and_others(elements)
        if any(one.own is not None for one in others):  # runs a user's code, each time
            return self._simulate(linear, others, ag)
        key = (linear, tuple(others), hashlib.sha256(ag.tobytes()).digest())
        if key not in self._simulated:
            while len(self._simulated) >= _KEPT_REFERENCES:
                del self._simulated[next(iter(self._simulated))]
            self._simulated[key] = self._simulate(linear, others, ag)
        x, v, force, values = (one.copy() for one in self._simulated[key])
        return x, v, force, values

    @functools.cached_property
    def _simulated(self) -> dict[Any, tuple[Floats, Floats, Floats, Floats]]:
        """The last references: a check needs that of an elastic specimen and that of the rig's.

        With an elastic rig they are the same, and a large structure takes seconds for each.
        """
        return {}

    def _simulate(
        self, linear: tuple[float, float, float], others: Sequence[ElementConfig], ag: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        mass, damping, spring = linear
        part = _with(self.part, mass, damping, spring)
        x, v, force, values = SparsePart(part).joined(others, ag, len(part.responses))
        for i, one in enumerate(part.responses):
            values[:, i] += sum(by for _, by in one.interfaces) * spring * x
        return x, v, force + spring * x, values

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """Return the displacement of the interface with an elastic specimen, (n,)."""
        model = [
            core.element("stiffness", k_n_per_m=self.part.k_e_n_per_m[0]),
            core.element("inertia", m_kg=self.specimen_mass_kg),
        ]
        return self.reference(model, ag_mps2)[0]


def _times(matrix: Symmetric, factor: float) -> Symmetric:
    return replace(matrix, value=factor * matrix.value)


@dataclass(frozen=True, eq=False)
class JointModel:
    """A specimen along several interfaces: matrices, (m, m), and elements with their interface."""

    stiffness: Floats
    damping: Floats
    mass: Floats
    elements: tuple[tuple[int, ElementConfig], ...] = ()


def joint_reference(
    structure: SparseStructure, model: JointModel, ag_mps2: ArrayLike
) -> tuple[Floats, Floats, Floats, Floats]:
    """Simulate a structure with several interfaces joined to a model of the specimen.

    Args:
        structure: the numerical part.
        model: its linear part is added to the matrices and so is not delayed; its elements receive
            the displacement of the sample, and the velocity by differences.
        ag_mps2: ground acceleration at every sample, (n,).

    Returns:
        Displacement, velocity and the model's force along the interfaces, (n, m) each; responses by
        name, (n, responses), with the model's force in those that contain the specimen's.
    """
    part, ag = structure.part, np.atleast_1d(np.asarray(ag_mps2, dtype=np.float64))
    rows, m = part.interface_rows(), len(part.interfaces)

    def more(matrix: Symmetric, added: Floats) -> Symmetric:
        whole = rows.T @ added @ rows
        return Symmetric.of(matrix.matrix() + whole)

    own = part.damping_n_s_per_m or Symmetric.zero(part.size)
    joined = replace(
        part,
        mass_kg=more(part.mass_kg, model.mass),
        stiffness_n_per_m=more(part.stiffness_n_per_m, model.stiffness),
        damping_n_s_per_m=more(own, model.damping),
        k_e_n_per_m=(0.0,) * m,
        k_e_between=(),
    )
    if part.by_stiffness_s:
        # Rayleigh damping referred to the stiffness that includes k_e.
        k_e = np.diag(part.k_e_n_per_m) + (np.array(part.k_e_between) if part.k_e_between else 0.0)
        less = part.by_stiffness_s * (k_e - model.stiffness)
        damped = joined.damping_n_s_per_m
        assert damped is not None
        joined = replace(joined, damping_n_s_per_m=more(damped, less))
    elements = [(along, core.CoreElement(one)) for along, one in model.elements]
    return _run_joint(SparsePart(joined), model, elements, ag, m)


def _run_joint(
    part: SparsePart, model: JointModel, elements: Sequence[tuple[int, Any]], ag: Floats, m: int
) -> tuple[Floats, Floats, Floats, Floats]:
    h, n = part.config.period_s, ag.size
    x, extra = np.zeros((n, m)), np.zeros((n, m))
    responses = np.zeros((n, len(part.config.responses)))
    at, before = np.zeros(m), np.zeros(m)
    for i, excitation in enumerate(ag.tolist()):
        x[i] = at
        for along, one in elements:
            velocity = float(at[along] - before[along]) / h
            extra[i, along] += one.force(float(at[along]), velocity, 0.0, h)
        before = at
        at, _ = part.answer_all(excitation, extra[i].tolist())
        responses[i] = part.responses()
        part.advance()
    v = np.asarray(np.gradient(x, h, axis=0)) if n > 1 else np.zeros_like(x)
    a = np.asarray(np.gradient(v, h, axis=0)) if n > 1 else np.zeros_like(x)
    linear = x @ model.stiffness + v @ model.damping + a @ model.mass
    for column, one in enumerate(part.config.responses):
        for interface, by in one.interfaces:
            responses[:, column] += by * linear[:, interface]
    return x, v, linear + extra, responses


def _less_steep(friction: ElementConfig, steep: float) -> str:
    """Return the value that makes a law of friction less steep at rest by a factor, in words."""
    values = dict(zip(core.ELEMENT_PARAMS[friction.kind], friction.params, strict=True))
    # The slope of |v|^a at rest is in proportion to the width to the power of a - 1.
    power = 1.0 - values["exponent"] if friction.kind == "power_damping" else 1.0
    room = FRICTION_WIDTH_MAX / values["width_m_per_s"]
    if math.log(steep) > power * math.log(room):
        return f"{1.0 / steep:.2g} times the force"
    return f"a width_m_per_s that is {steep ** (1.0 / power):.2g} times as large"


def _with(part: SparseConfig, mass: float, damping: float, spring: float) -> SparseConfig:
    """Return a part with a linear element added at its interface; its spring is taken from k_e."""
    if not (mass or damping or spring):
        return part
    row = part.interface_rows()[0]
    at = np.flatnonzero(row)
    square = np.zeros((at.size, at.size))
    square[:] = np.outer(row[at], row[at])

    def more(matrix: Symmetric, value: float) -> Symmetric:
        if not value:
            return matrix
        i, j = np.triu_indices(at.size)
        return Symmetric.of_entries(
            matrix.size,
            np.concatenate([matrix.row, at[i]]),
            np.concatenate([matrix.column, at[j]]),
            np.concatenate([matrix.value, value * square[i, j]]),
        )

    own = part.damping_n_s_per_m or Symmetric.zero(part.size)
    return replace(
        part,
        mass_kg=more(part.mass_kg, mass),
        stiffness_n_per_m=more(part.stiffness_n_per_m, spring),
        damping_n_s_per_m=more(own, damping) if damping else part.damping_n_s_per_m,
        # Rayleigh damping still refers to the same stiffness.
        k_e_n_per_m=(max(part.k_e_n_per_m[0] - spring, 0.0),),
    )


# ---- from the keys ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Keys:
    """The keys of a test file for a structure, in addition to its storeys or matrices.

    Attributes:
        damping: damping in modes; None: that of the file of matrices.
        nonlinear: nonlinear elements.
        record: names of the responses to record; None: drifts and shears of a few storeys.
        interfaces: what the actuators move.
        integrator, rho_inf: of the numerical part.
        turns: which interfaces are rotations; empty: none.
    """

    damping: Damping | None
    nonlinear: Sequence[Nonlinear]
    record: Sequence[str] | None
    interfaces: Sequence[Interface]
    integrator: str
    rho_inf: float
    turns: Sequence[bool] = ()


@dataclass
class _Bare:
    """A structure without its damping."""

    labels: tuple[str, ...]
    mass: Symmetric
    stiffness: Symmetric
    damping: Symmetric | None
    influence: Floats
    load: Floats
    interfaces: tuple[tuple[Term, ...], ...]
    joints: list[Joint]
    responses: list[Response]
    specimen_mass_kg: float = 0.0
    heights_m: tuple[float, ...] = ()
    directions: Mapping[str, Floats] = field(default_factory=dict)


def build(
    given: Storeys | MatrixFile, keys: Keys, k_e_n_per_m: float | Rows, period_s: float
) -> SparseStructure:
    """Return the structure that a test file describes.

    Args:
        given: storeys, or the matrices of a file that was read.
        keys: the other keys of the structure.
        k_e_n_per_m: elastic stiffness of the rig's specimen; with several axes, its rows along the
            interfaces, in their order.
        period_s: sampling period.

    Raises:
        InputError: naming the first inconsistency.
    """
    k_e = np.atleast_2d(np.asarray(k_e_n_per_m, dtype=np.float64))
    bare = (
        _of_storeys(given, keys, len(k_e))
        if isinstance(given, Storeys)
        else _of_file(given, keys, k_e)
    )
    _check_count(bare, keys, len(k_e))
    between = tuple(tuple(row) for row in (k_e - np.diag(np.diag(k_e))).tolist())
    part = SparseConfig(
        bare.mass,
        bare.stiffness,
        bare.load,
        bare.interfaces,
        tuple(float(k) for k in np.diag(k_e)),
        damping_n_s_per_m=bare.damping if keys.damping is None else None,
        joints=tuple(bare.joints),
        responses=tuple(bare.responses),
        integrator=cast(SparseIntegrator, keys.integrator),
        rho_inf=keys.rho_inf,
        period_s=period_s,
        k_e_between=between if np.any(between) else (),
    )
    names = tuple(one.name for one in keys.interfaces) or ("x",)
    structure = SparseStructure(
        bare.labels, part, bare.influence, bare.specimen_mass_kg, names, bare.heights_m,
        bare.directions,
    )  # fmt: skip
    place = "numerical.storeys" if isinstance(given, Storeys) else "numerical.matrices"
    try:
        _check_masses(bare, keys)
        if keys.damping is not None:
            structure = replace(structure, part=_damped(structure, keys.damping))
        SparsePart(structure.part)
        structure.modes()
    except LibraryMissing as error:
        raise InputError(str(error), place) from error
    except CoreError as error:
        leaning = isinstance(given, Storeys) and given.p_delta
        raise InputError(
            f"{error}{_where_loose(structure)}; every motion must have a mass or a stiffness and "
            "must be restrained: "
            + (
                "check for a weight in p_delta under which the storeys topple, "
                if leaning
                else "look for "
            )
            + "a missing spring, a wrong sign, or a subtracted specimen that is stiffer than the "
            "rig's " + (f"k_e = {k_e[0, 0]:g} N/m" if len(k_e) == 1 else "specimen.stiffness"),
            place,
        ) from error
    _check_step(structure)
    return structure


def _where_loose(structure: SparseStructure) -> str:
    """Return where a motion that nothing restrains is largest, in words; empty if there is none."""
    shape = least_restrained(structure.part)
    if shape is None:
        return ""
    # Rounded, so that degrees of freedom that move as far stand in the order of their rows.
    order = np.argsort(-np.round(np.abs(shape), 3), kind="stable")
    moving = [int(at) for at in order if abs(shape[at]) >= _CLEARLY]
    return f": nothing restrains {_named([structure.labels[at] for at in moving])}"


def _named(labels: Sequence[str]) -> str:
    """Return labels for a message, the first `_NAMED` of them."""
    more = len(labels) - _NAMED
    names = ", ".join(written(label) for label in labels[:_NAMED])
    return names + (f" and {more} more" if more > 0 else "")


def _check_count(bare: _Bare, keys: Keys, axes: int) -> None:
    found = len(bare.interfaces)
    if found == axes:
        return
    names = ", ".join(one.name for one in keys.interfaces)
    raise InputError(
        f"found {found} directions{f' ({names})' if names else ''}; the rig has "
        + ("one actuator, which moves one" if axes == 1 else f"{axes} axes and needs as many"),
        "interface",
    )


def _check_masses(bare: _Bare, keys: Keys) -> None:
    """Reject motions without mass if the integrator has no way to bring them to rest.

    Their frequency is infinite, and there the roots of a step are -rho_inf (Kolay & Ricles 2014).
    With 1, which is also `cr`, they change their sign at every sample and do not decay, whatever
    the stiffness and damping; central differences divide by the mass.

    Raises:
        InputError: naming the motions, and what may be used instead.
        LibraryMissing: qdldl or SciPy is not installed.
    """
    if keys.integrator == "kr-alpha" and keys.rho_inf < 1.0:
        return
    mass = bare.mass.matrix()
    without = [label for label, m in zip(bare.labels, mass.diagonal(), strict=True) if m == 0.0]
    where = _named(without)
    if not without:
        try:
            factored(mass, "the mass matrix")
            return
        except LibraryMissing:
            raise
        except CoreError as error:
            where = f"a combination of degrees of freedom ({error})"
    own = keys.integrator == "kr-alpha"
    reason = (
        "which divides by the mass"
        if keys.integrator == "central-difference"
        else "with which a motion without mass changes its sign at every sample and does not decay "
        "(spectral radius 1 at infinite frequency)"
    )
    raise InputError(
        f"found {'rho_inf = 1' if own else written(keys.integrator)}, {reason}; without mass: "
        f'{where}; use integrator = "kr-alpha" with rho_inf from 0 to below 1 (without the key '
        "0.8), or give these motions a mass",
        "numerical.rho_inf" if own else "numerical.integrator",
    )


def _check_step(structure: SparseStructure) -> None:
    """Reject central differences if they are unstable for the highest mode."""
    if structure.part.integrator != "central-difference":
        return
    k, m = structure.joined.whole_stiffness(), structure.joined.mass_kg.matrix()
    from scipy.sparse.linalg import eigsh

    if structure.part.size < 3:
        import scipy.linalg

        highest = float(scipy.linalg.eigh(k.toarray(), m.toarray(), eigvals_only=True)[-1])
    else:
        highest = float(eigsh(k, 1, m, which="LM", return_eigenvectors=False, tol=1e-4)[0])
    omega, rate = math.sqrt(highest), 1.0 / structure.part.period_s
    if omega >= 2.0 * rate:
        raise InputError(
            f"central-difference at {rate:g} Hz is unstable: the highest mode of the structure is "
            f"at {omega / (2 * math.pi):.4g} Hz and must be below {rate / math.pi:.4g} Hz; use "
            'integrator = "kr-alpha", which has no such bound',
            "numerical.integrator",
        )


def _damped(structure: SparseStructure, damping: Damping) -> SparseConfig:
    """Return the part with damping ratios in modes of the complete structure."""
    part = structure.part
    most = max(damping.modes)
    w2, shapes = lowest_modes(structure.joined, most)
    if len(w2) < most:
        raise InputError(
            f"found mode {most}; the structure has {len(w2)} modes with a mass",
            "numerical.damping.modes",
        )
    w = np.sqrt(w2[[mode - 1 for mode in damping.modes]])
    ratios = np.array(damping.ratios)
    if damping.form == "modal":
        own = part.mass_kg.matrix() @ shapes[:, [mode - 1 for mode in damping.modes]]
        return replace(part, modal=np.asarray(own * np.sqrt(2.0 * ratios * w)))
    if len(w) == 1:
        return replace(part, by_mass_per_s=float(2.0 * ratios[0] * w[0]))
    a, b = np.linalg.solve(np.column_stack([1.0 / w, w]), 2.0 * ratios)
    if min(a, b) < 0.0:
        raise InputError(
            f"ratios of {ratios[0]:g} and {ratios[1]:g} at {w[0] / 6.2832:.4g} and "
            f"{w[1] / 6.2832:.4g} Hz make Rayleigh damping negative at other frequencies; choose "
            'ratios that are closer together, or use form = "modal"',
            "numerical.damping.ratio",
        )
    return replace(part, by_mass_per_s=float(a), by_stiffness_s=float(b))


def _joint(below: int, above: int, law: Any) -> Joint:
    element = core_element(law)
    return Joint(below, above, element, initial_stiffness(element))


# ---- storeys ------------------------------------------------------------------------------------


def _drift(storey: int) -> tuple[Term, ...]:
    return ((storey - 1, 1.0),) + (((storey - 2, -1.0),) if storey > 1 else ())


def _of_storeys(given: Storeys, keys: Keys, axes: int) -> _Bare:
    n, specimens = given.count, _specimens(given, keys, axes)
    masses, stiffness = given.each("mass_kg"), given.each("stiffness_n_per_m")
    for specimen in specimens:
        stiffness[specimen - 1] = 0.0
    joints: list[Joint] = []
    in_storey: dict[int, list[int]] = {}
    for i, one in enumerate(keys.nonlinear):
        if one.storeys is None:
            raise InputError(
                "found degrees of freedom; this structure is given by storeys, so give the "
                "storeys in each of which the element acts, for example storeys = [2, 3]",
                f"numerical.nonlinear.{i}",
            )  # fmt: skip
        for storey in one.storeys:
            place = f"numerical.nonlinear.{i}.storeys"
            _check_storey(storey, n, place)
            if storey in specimens and not one.beside:
                raise InputError(
                    f"found storey {storey}, which is the specimen and is not computed; name "
                    "another storey, or set beside = true to add the element in parallel with the "
                    "specimen",
                    place,
                )  # fmt: skip
            if not one.beside:
                stiffness[storey - 1] = 0.0
            in_storey.setdefault(storey, []).append(len(joints))
            joints.append(_joint(storey - 2 if storey > 1 else GROUND, storey - 1, one.law))
    columns = list(stiffness)
    if given.p_delta:
        weights = GRAVITY_M_PER_S2 * np.cumsum(masses[::-1])[::-1]
        for i, height in enumerate(given.each("height_m")):
            columns[i] -= float(weights[i]) / height
    entries = [
        (min(i, j), max(i, j), columns[s - 1] * by * other)
        for s in range(1, n + 1)
        for i, by in _drift(s)
        for j, other in _drift(s)
        if i <= j
    ]
    row, column, value = (np.array(part) for part in zip(*entries, strict=True))
    at = np.arange(n)
    heights = given.each("height_m") if given.height_m is not None else [3.0] * n
    bare = _Bare(
        labels=tuple(str(i) for i in range(1, n + 1)),
        mass=Symmetric.of_entries(n, at, at, np.array(masses)),
        stiffness=Symmetric.of_entries(n, row, column, value),
        damping=None,
        influence=np.ones(n),
        load=np.array(masses),
        interfaces=tuple(_drift(specimen) for specimen in specimens),
        joints=joints,
        responses=[],
        heights_m=tuple(float(v) for v in np.cumsum(heights)),
    )
    bare.responses = _storey_responses(given, specimens, keys.record, stiffness, in_storey)
    return bare


def _check_storey(storey: int, count: int, place: str) -> None:
    if storey > count:
        raise InputError(f"found storey {storey} of {count}; must be one of 1 to {count}", place)


def _specimens(given: Storeys, keys: Keys, axes: int) -> list[int]:
    """Return the storeys in the laboratory, in the order of the interfaces."""
    if axes == 1 and len(given.specimen) > 1:
        raise InputError(
            f"found the storeys {given.specimen}; the rig has one actuator, which moves one",
            "numerical.storeys.specimen",
        )
    if axes > 1 and not keys.interfaces:
        raise InputError(
            "missing; on a rig with several axes, assign each interface direction to a storey: "
            "[[interface]] with name and storey",
            "interface",
        )
    if not keys.interfaces:
        return given.specimen
    for i, one in enumerate(keys.interfaces):
        if one.storey not in given.specimen:
            found = f"storey {one.storey}" if one.storey else "a degree of freedom"
            known = " or ".join(map(str, given.specimen))
            raise InputError(
                f"found {found}; the actuator moves the specimen, storey {known}: write "
                f"storey = {given.specimen[0]}, or change numerical.storeys.specimen",
                f"interface.{i}",
            )
    return [one.storey for one in keys.interfaces if one.storey]


def _storey_responses(
    given: Storeys,
    specimens: Sequence[int],
    wanted: Sequence[str] | None,
    stiffness: Sequence[float],
    in_storey: Mapping[int, list[int]],
) -> list[Response]:
    n = given.count
    if wanted is None:
        few = range(1, n + 1) if n <= DEFAULT_RECORDED else ()
        wanted = [f"{what}_{s}" for what in ("drift", "shear") for s in few]
    found = []
    for i, name in enumerate(wanted):
        floors = _FLOORS.fullmatch(name)
        if floors is not None and floors[1] != floors[2] and max(map(int, floors.groups())) <= n:
            upper, lower = map(int, floors.groups())
            terms = ((upper - 1, 1.0), (lower - 1, -1.0))
            found.append(Response(f"x_{upper}_less_x_{lower}", "m", terms))
            continue
        match = re.fullmatch(r"(x|drift|shear)_([1-9]\d*)", name)
        storey = int(match[2]) if match else 0
        if match is None or storey > n:
            raise InputError(
                f"found {written(name)}; with {n} storeys the quantities are x_1 to x_{n} "
                "(displacement relative to the ground), the difference of two of them "
                f'("x_2 - x_1"), drift_1 to drift_{n}, and shear_1 to shear_{n}',
                f"numerical.record.{i}",
            )
        if match[1] == "x":
            found.append(Response(name, "m", ((storey - 1, 1.0),)))
        elif match[1] == "drift":
            found.append(Response(name, "m", _drift(storey)))
        else:
            own = stiffness[storey - 1]
            found.append(
                Response(
                    name,
                    "N",
                    tuple((at, by * own) for at, by in _drift(storey)) if own else (),
                    tuple((at, 1.0) for at in in_storey.get(storey, ())),
                    ((specimens.index(storey), 1.0),) if storey in specimens else (),
                )
            )
    return found


# ---- matrices -----------------------------------------------------------------------------------


def _of_file(given: MatrixFile, keys: Keys, k_e: Floats) -> _Bare:
    if given.data is None:
        raise InputError(
            "the file was not read; load the test file from its own folder", "numerical.matrices"
        )
    data = matrixfile.unpacked(given.data)
    n, place = data.size, {label: i for i, label in enumerate(data.labels)}
    if keys.damping is None and data.damping_n_s_per_m is None:
        raise InputError(
            "missing, and the file has no C; give damping = { ratio = 0.02, modes = [1, 2] }",
            "numerical.damping",
        )
    influence = _direction(given, data)
    interfaces = _interfaces_of(keys.interfaces, data.labels, place)
    joints, entry_joint = list[Joint](), list[int]()
    for i, one in enumerate(keys.nonlinear):
        at = f"numerical.nonlinear.{i}"
        if one.storeys is not None:
            raise InputError("found storeys; with matrices use dof or between", f"{at}.storeys")
        ends = [one.dof] if one.dof is not None else list(one.between or ())
        found = [_find(label, data.labels, place, at) for label in ends]
        if len(set(found)) < len(found):
            raise InputError(f"found {written(ends[0])} twice; two different are needed", at)
        entry_joint.append(len(joints))
        joints.append(_joint(GROUND if len(found) == 1 else found[0], found[-1], one.law))
    mass, stiffness, damping = data.mass_kg, data.stiffness_n_per_m, data.damping_n_s_per_m
    load = np.asarray(mass.matrix() @ influence)
    taken_mass = 0.0
    if given.specimen is not None:
        out = given.specimen
        taken_mass = out.mass_kg
        k = float(k_e[0, 0]) if out.stiffness_n_per_m is None else out.stiffness_n_per_m
        row = np.zeros(n)
        if len(interfaces) > 1:
            raise InputError(
                "subtracting the specimen is not supported with several interface directions: give "
                "the matrices of the numerical part alone",
                "numerical.matrices.specimen",
            )
        for dof, by in interfaces[0]:
            row[dof] = by
        mass = _less(mass, row, out.mass_kg)
        stiffness = _less(stiffness, row, k)
        damping = damping if damping is None else _less(damping, row, out.damping_n_s_per_m)
    units = DofUnits(data, interfaces, keys.turns)
    entries = [(at, (joints[at].above, joints[at].below)) for at in entry_joint]
    responses = _label_responses(keys.record or (), units, place, entries)
    return _Bare(
        data.labels, mass, stiffness, damping, influence, load, interfaces, joints,
        responses, taken_mass, directions=data.influence,
    )  # fmt: skip


def _less(matrix: Symmetric, row: Floats, value: float) -> Symmetric:
    if not value:
        return matrix
    at = np.flatnonzero(row)
    i, j = np.triu_indices(at.size)
    return Symmetric.of_entries(
        matrix.size,
        np.concatenate([matrix.row, at[i]]),
        np.concatenate([matrix.column, at[j]]),
        np.concatenate([matrix.value, -value * row[at[i]] * row[at[j]]]),
    )


def _direction(given: MatrixFile, data: matrixfile.MatrixData) -> Floats:
    known = list(data.influence)
    where = "numerical.matrices.direction"
    if not known:
        if given.direction is not None:
            raise InputError(
                f"found {written(given.direction)}; the file has no influence vectors", where
            )
        return np.ones(data.size)
    if given.direction is None:
        if len(known) > 1:
            raise InputError(f"missing; must be one of {', '.join(map(written, known))}", where)
        return data.influence[known[0]]
    if given.direction not in data.influence:
        raise InputError(
            f"found {written(given.direction)}; must be one of {', '.join(map(written, known))}",
            where,
        )
    return data.influence[given.direction]


def _find(label: str, labels: Sequence[str], place: Mapping[str, int], where: str) -> int:
    if label in place:
        return place[label]
    shown = ", ".join(written(one) for one in labels[:8]) + (", ..." if len(labels) > 8 else "")
    raise InputError(
        f"found {written(label)}{nearest(label, list(labels))}; must be a label of the structure: "
        f"{shown}",
        where,
    )


def _interfaces_of(
    given: Sequence[Interface], labels: Sequence[str], place: Mapping[str, int]
) -> tuple[tuple[Term, ...], ...]:
    if not given:
        raise InputError(
            'missing; state what the actuator moves: [[interface]] with dof = "LABEL"', "interface"
        )
    found = []
    for i, one in enumerate(given):
        where = f"interface.{i}"
        if one.dof is None:
            raise InputError("found a storey; with matrices use dof", where)
        terms = tuple((_find(label, labels, place, f"{where}.dof"), by) for label, by in one.dof)
        if len({at for at, _ in terms}) < len(terms):
            raise InputError(
                "found a degree of freedom twice; each may occur only once", f"{where}.dof"
            )
        found.append(terms)
    rows = np.zeros((len(found), len(labels)))
    for row, terms in zip(rows, found, strict=True):
        for at, by in terms:
            row[at] = by
    if np.linalg.matrix_rank(rows) < len(rows):
        raise InputError(
            "the directions are not independent: one of them is a combination of the others, so "
            "two actuators would drive the same motion", "interface",
        )  # fmt: skip
    return tuple(found)


def _label_responses(
    wanted: Sequence[str],
    units: DofUnits,
    place: Mapping[str, int],
    joints: Sequence[tuple[int, Sequence[int]]],
) -> list[Response]:
    labels = units.data.labels
    found: list[Response] = []
    for i, text in enumerate(wanted):
        where = f"numerical.record.{i}"
        match = re.fullmatch(r"element_([1-9]\d*)", text)
        if match and text not in place:
            if int(match[1]) > len(joints):
                raise InputError(
                    f"found {written(text)}; there are {len(joints)} [[numerical.nonlinear]] "
                    "tables, counted from 1",
                    where,
                )
            at, both = joints[int(match[1]) - 1]
            found.append(Response(text, units.of_force(both), joints=((at, 1.0),)))
            continue
        difference = None if text in place else _DIFFERENCE.fullmatch(text)
        ends = [text] if difference is None else [difference[1], difference[2]]
        terms = [
            (_find(label, labels, place, where), by)
            for label, by in zip(ends, (1.0, -1.0), strict=False)
        ]
        name = "dof_" + re.sub(r"[^a-z0-9]+", "_", " less ".join(ends).lower()).strip("_")
        found.append(Response(name[:32], units.of([at for at, _ in terms]), tuple(terms)))
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(
            f"two of them would both be recorded as {twice}, because labels are cut to 32 "
            "characters; use shorter labels", "numerical.record",
        )  # fmt: skip
    return found
