"""A numerical part of any size: its settings, factored and laid out for ``numerical_sparse.c``.

SciPy and qdldl do what is needed once: the matrix products, the elimination order (AMD) and the
factorisation L D L'. Everything that runs during a test is C.
"""

from __future__ import annotations

import base64
import io
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import CoreError, LibraryMissing
from rthyb_rt.core.settings import ElementConfig, init_element, recorded_element
from rthyb_rt.core.sizes import PERIOD_S

SparseIntegrator = Literal["kr-alpha", "cr", "central-difference"]
Floats = NDArray[np.float64]
Whole = NDArray[np.int32]
Term = tuple[int, float]
"""Index of a degree of freedom, from 0, and its weight."""

SPARSE_MAX: Final[int] = lib.RTHYB_SPARSE_MAX
INTERFACES_MAX: Final[int] = lib.RTHYB_INTERFACES_MAX
RESPONSES_MAX: Final[int] = lib.RTHYB_RESPONSES_MAX
MODES_MAX: Final[int] = lib.RTHYB_SPARSE_MODES_MAX
SLIDERS_MAX: Final[int] = lib.RTHYB_SLIDERS_MAX
GROUND: Final = -1


@dataclass(frozen=True, eq=False)
class Symmetric:
    """A symmetric sparse matrix: the entries on and above its diagonal, each stored once.

    Attributes:
        size: n, number of rows and columns.
        row, column: indices of the entries, row <= column, (count,).
        value: values of the entries, (count,).
    """

    size: int
    row: Whole
    column: Whole
    value: Floats

    @classmethod
    def of(cls, matrix: Any) -> Symmetric:
        """Return the matrix from an array or a SciPy matrix, whose lower triangle is ignored."""
        sparse = _scipy_sparse()
        upper = sparse.triu(sparse.csc_matrix(matrix, dtype=np.float64), format="coo")
        upper.sum_duplicates()
        kept = upper.data != 0.0
        return cls(
            upper.shape[0],
            upper.row[kept].astype(np.int32),
            upper.col[kept].astype(np.int32),
            upper.data[kept].astype(np.float64),
        )

    @classmethod
    def of_entries(cls, size: int, row: Any, column: Any, value: Any) -> Symmetric:
        """Return the matrix from entries on and above its diagonal; duplicates are summed."""
        sparse = _scipy_sparse()
        return cls.of(sparse.coo_matrix((value, (row, column)), shape=(size, size)))

    @classmethod
    def zero(cls, size: int) -> Symmetric:
        """Return the zero matrix."""
        none = np.zeros(0, np.int32)
        return cls(size, none, none, np.zeros(0))

    def matrix(self) -> Any:
        """Return both triangles as a ``scipy.sparse.csc_matrix``, (n, n)."""
        sparse = _scipy_sparse()
        shape = (self.size, self.size)
        upper = sparse.coo_matrix((self.value, (self.row, self.column)), shape=shape)
        return (upper + sparse.triu(upper, 1).T).tocsc()


@dataclass(frozen=True)
class Joint:
    """An element of the catalogue between two degrees of freedom, or a degree and the `GROUND`.

    Its deformation is x[above] - x[below]. ``stiffness_n_per_m`` is its initial stiffness, which
    the integrator needs. Dry friction is ``solved`` for with the step, at the velocity of the same
    instant; otherwise, it is evaluated at an extrapolated velocity, as all other elements are.
    """

    below: int
    above: int
    element: ElementConfig
    stiffness_n_per_m: float = 0.0
    solved: bool = True


@dataclass(frozen=True)
class Response:
    """A named value: weighted displacements, forces of joints and forces at interfaces."""

    name: str
    unit: str
    displacements: tuple[Term, ...] = ()
    joints: tuple[Term, ...] = ()
    interfaces: tuple[Term, ...] = ()


@dataclass(frozen=True)
class Weights:
    """The weights of an integrator: Kolay & Ricles (2014), by ``rho_inf``.

    With ``rho_inf`` 1 their method averages the equation of Chen & Ricles (2008) over two samples.
    Started in equilibrium the two agree; without the average nothing with a mass can oscillate at
    half the rate.
    """

    alpha_m: float
    alpha_f: float
    gamma: float
    beta: float

    @classmethod
    def of(cls, integrator: SparseIntegrator, rho_inf: float) -> Weights:
        """Return the weights; those of the central difference put no stiffness into the step."""
        if integrator == "central-difference":
            return cls(0.0, 0.0, 0.5, 0.0)
        rho = 1.0 if integrator == "cr" else rho_inf
        if rho == 1.0:
            return cls(0.0, 0.0, 0.5, 0.25)
        alpha_m, alpha_f = (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0)
        gamma = 0.5 - alpha_m + alpha_f
        return cls(alpha_m, alpha_f, gamma, 0.25 * (0.5 + gamma) ** 2)


@dataclass(frozen=True, eq=False)
class SparseConfig:
    """Settings of a numerical part, ``M a + C v + K x + joints + B f = -load ag``.

    Attributes:
        mass_kg, stiffness_n_per_m: of the part alone, without joints; the mass may be singular.
        load_kg: force for a ground acceleration of -1 m/s^2, (n,).
        interfaces: weighted degrees of freedom that each actuator moves; its force acts on them
            with the same weights.
        k_e_n_per_m: elastic stiffness of the specimen at each interface.
        k_e_between: elastic stiffness between interfaces: rows of a symmetric matrix with zero
            diagonal; empty: none.
        damping_n_s_per_m: damping in addition to the two forms below; None: none.
        by_mass_per_s, by_stiffness_s: Rayleigh damping a M + b K, where K includes the initial
            stiffness of joints and specimen.
        modal: U of modal damping U U', (n, r).
        joints: nonlinear elements.
        responses: quantities to record.
        integrator, rho_inf: ``rho_inf`` is used by ``kr-alpha`` only.
        first_x_m, first_v_m_per_s: initial state, (n,); None: at rest at 0.
    """

    mass_kg: Symmetric
    stiffness_n_per_m: Symmetric
    load_kg: Floats
    interfaces: tuple[tuple[Term, ...], ...]
    k_e_n_per_m: tuple[float, ...]
    damping_n_s_per_m: Symmetric | None = None
    by_mass_per_s: float = 0.0
    by_stiffness_s: float = 0.0
    modal: Floats | None = None
    joints: tuple[Joint, ...] = ()
    responses: tuple[Response, ...] = ()
    integrator: SparseIntegrator = "kr-alpha"
    rho_inf: float = 1.0
    first_x_m: Floats | None = None
    first_v_m_per_s: Floats | None = None
    period_s: float = PERIOD_S
    k_e_between: tuple[tuple[float, ...], ...] = ()
    kind: ClassVar[str] = "sparse"
    _laid_out: list[tuple[Any, Layout]] = field(default_factory=list, init=False, repr=False)

    @property
    def size(self) -> int:
        """n, the number of degrees of freedom."""
        return self.mass_kg.size

    def whole_stiffness(self) -> Any:
        """Return K including the initial stiffness of joints and specimen, csc (n, n)."""
        sparse = _scipy_sparse()
        rows = [self._between(j.below, j.above) for j in self.joints]
        values = [j.stiffness_n_per_m for j in self.joints]
        rows += self.interfaces
        values += self.k_e_n_per_m
        b = _terms_matrix(rows, self.size)
        whole = self.stiffness_n_per_m.matrix() + b.T @ sparse.diags(values) @ b
        if self.k_e_between:
            at = _terms_matrix(self.interfaces, self.size)
            whole = whole + at.T @ sparse.csr_matrix(np.array(self.k_e_between)) @ at
        return whole.tocsc()

    @staticmethod
    def _between(below: int, above: int) -> tuple[Term, ...]:
        return tuple((at, by) for at, by in ((below, -1.0), (above, 1.0)) if at != GROUND)

    def with_dry_friction(self) -> list[int]:
        """Return the numbers of the joints whose friction is to be solved for with the step."""
        found, slot = [], ffi.new("rthyb_element *")
        for i, joint in enumerate(self.joints):
            init_element(slot, joint.element)
            if joint.solved and lib.rthyb_is_dry_friction(slot):
                found.append(i)
        return found

    def steepest_friction(self) -> tuple[int, float]:
        """Return the joint whose friction is steepest for an explicit step, and how steep.

        That is its slope at rest times (1 - alpha_f) h B' S^-1 B: above 1 (rho_inf from 0.7 to 1;
        0.75 to 1.25 below), an explicit friction force changes its sign at every sample. -1 and 0.0
        if no joint has dry friction.
        """
        at = self.with_dry_friction()
        if not at:
            return -1, 0.0
        rows, response = self.struct()[1].across(at)
        slopes = [initial_damping(self.joints[i].element) for i in at]
        steep = self.period_s * np.einsum("ij,ij->i", rows, response) * np.array(slopes)
        return at[int(np.argmax(steep))], float(steep.max())

    def interface_rows(self) -> Floats:
        """Return B', (m, n)."""
        return np.asarray(_terms_matrix(self.interfaces, self.size).toarray())

    def stiffness_solver(self) -> Any:
        """Return ``qdldl.Solver`` of K including the initial stiffness of joints and specimen.

        Raises:
            CoreError: K is not positive definite: some motion is unrestrained.
        """
        return factored(self.whole_stiffness(), "the stiffness of the whole structure")

    def damping_times(self, v: Floats) -> Floats:
        """Return C v, (n,) or (n, m)."""
        total = self.by_mass_per_s * (self.mass_kg.matrix() @ v)
        total = total + self.by_stiffness_s * (self.whole_stiffness() @ v)
        if self.damping_n_s_per_m is not None:
            total = total + self.damping_n_s_per_m.matrix() @ v
        if self.modal is not None:
            total = total + self.modal @ (self.modal.T @ v)
        return np.asarray(total)

    def struct(self) -> tuple[Any, Layout]:
        """Return the ``rthyb_sparse_config`` of the C core, and the objects that must outlive it.

        Raises:
            CoreError: a matrix is singular where it must not be.
            LibraryMissing: qdldl or SciPy is not installed.
        """
        if not self._laid_out:
            self._laid_out.append(Layout(self).struct())
        return self._laid_out[0]

    # ---- in recordings -----------------------------------------------------------------------

    def plain(self) -> dict[str, Any]:
        """Return everything as plain values for a recording; `of_plain` restores it."""
        arrays: dict[str, NDArray[Any]] = {}
        values: dict[str, Any] = {}
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, Symmetric):
                for part in ("row", "column", "value"):
                    arrays[f"{one.name}.{part}"] = getattr(value, part)
            elif isinstance(value, np.ndarray):
                arrays[one.name] = value
            elif one.init and one.name not in ("joints", "responses"):
                values[one.name] = value
        values["joints"] = [
            [
                j.below,
                j.above,
                j.element.kind,
                list(j.element.params),
                j.stiffness_n_per_m,
                j.solved,
            ]
            for j in self.joints
        ]
        values["responses"] = [
            [r.name, r.unit, r.displacements, r.joints, r.interfaces] for r in self.responses
        ]
        held = io.BytesIO()
        np.savez(held, **arrays)  # type: ignore[arg-type]
        packed = base64.b64encode(zlib.compress(held.getvalue(), 9)).decode()
        return {"kind": "sparse", "size": self.size, "arrays": packed, **values}

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> SparseConfig:
        """Return the settings that `plain` described; raises ``KeyError`` or similar."""
        values = {k: v for k, v in plain.items() if k not in ("kind", "size", "arrays")}
        held = io.BytesIO(zlib.decompress(base64.b64decode(plain["arrays"])))
        with np.load(held, allow_pickle=False) as stored:
            arrays = dict(stored)
        for name in {key.partition(".")[0] for key in arrays if "." in key}:
            parts = (arrays.pop(f"{name}.{part}") for part in ("row", "column", "value"))
            values[name] = Symmetric(int(plain["size"]), *parts)
        values |= arrays
        values["interfaces"] = tuple(_as_terms(row) for row in values["interfaces"])
        values["k_e_n_per_m"] = tuple(values["k_e_n_per_m"])
        values["k_e_between"] = tuple(tuple(row) for row in values.get("k_e_between", ()))
        values["joints"] = tuple(
            # Recordings made before friction was solved for have no sixth value.
            Joint(below, above, recorded_element(kind, params), k, *(solved or (False,)))
            for below, above, kind, params, k, *solved in values["joints"]
        )
        values["responses"] = tuple(
            Response(name, unit, *(_as_terms(terms) for terms in rest))
            for name, unit, *rest in values["responses"]
        )
        return cls(**values)


def _as_terms(rows: Sequence[Sequence[float]]) -> tuple[Term, ...]:
    return tuple((int(at), float(by)) for at, by in rows)


def _scipy_sparse() -> Any:
    try:
        import scipy.sparse
    except ImportError as error:
        raise missing_library("SciPy") from error
    return scipy.sparse


def missing_library(name: str) -> LibraryMissing:
    """Return the error for a structure that needs a package that is not installed."""
    return LibraryMissing(
        f"{name} is not installed, but structures with many degrees of freedom need it: pip "
        'install "rthyb-rt[structures]"'
    )


def _terms_matrix(rows: Sequence[tuple[Term, ...]], n: int) -> Any:
    sparse = _scipy_sparse()
    entries = [(i, at, by) for i, row in enumerate(rows) for at, by in row]
    i, at, by = (list(column) for column in zip(*entries, strict=True)) if entries else ([], [], [])
    return sparse.coo_matrix((by, (i, at)), shape=(len(rows), n)).tocsr()


def _panels(lower: Any) -> NDArray[np.int32]:
    """Return where runs of columns with the same rows below them begin, and their number.

    Args:
        lower: a factor, (n, n), stored by columns with sorted rows.
    """
    start, at = lower.indptr, lower.indices
    n = lower.shape[0]
    begins = np.ones(n + 1, dtype=bool)
    for j in range(n - 1):
        rows, of_next = at[start[j] : start[j + 1]], at[start[j + 1] : start[j + 2]]
        alike = rows.size == of_next.size + 1 and rows[0] == j + 1
        begins[j + 1] = not (alike and np.array_equal(rows[1:], of_next))
    return np.flatnonzero(begins).astype(np.int32)


def factored(matrix: Any, what: str) -> Any:
    """Return ``qdldl.Solver`` of a symmetric matrix that must be positive definite.

    Raises:
        CoreError: the matrix is not positive definite.
        LibraryMissing: qdldl or SciPy is not installed.
    """
    try:
        import qdldl
    except ImportError as error:
        raise missing_library("qdldl") from error
    csc = _scipy_sparse().csc_matrix(matrix)
    csc.sort_indices()
    try:
        solver = qdldl.Solver(csc)
        _, d, order = solver.factors()
    except (RuntimeError, ValueError) as error:
        raise CoreError(f"{what} is singular") from error
    # A pivot is what elimination leaves of its diagonal entry: next to nothing is rounding.
    if not np.all(np.isfinite(d)) or np.any(d <= _PIVOT_ROUNDING * np.abs(csc.diagonal()[order])):
        raise CoreError(f"{what} is not positive definite")
    return solver


_PIVOT_ROUNDING: Final = 1e-13
"""Share of its diagonal entry below which a pivot is no stiffness: fewer than three of its sixteen
digits survive the subtractions. Frames that are free to turn leave up to 1e-14 of either sign."""


def lowest_modes(config: SparseConfig, count: int) -> tuple[Floats, Floats]:
    """Return the lowest modes of the complete structure with an elastic specimen.

    Args:
        config: the part.
        count: number of modes; fewer are returned if fewer degrees of freedom have mass.

    Returns:
        omega^2, ascending, (r,), and mode shapes with phi' M phi = 1 as columns, (n, r).

    Raises:
        CoreError: some motion is unrestrained, or the modes cannot be computed.
    """
    k, m = config.whole_stiffness(), config.mass_kg.matrix()
    solver = config.stiffness_solver()
    moving = np.flatnonzero(np.asarray(abs(m).sum(axis=0)).ravel())
    if moving.size <= max(2 * count, _DENSE_MODES):
        return _modes_by_flexibility(solver, m, moving, min(count, moving.size))
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

    # Largest eigenvalues of K^-1 M, which is symmetric in the M inner product; M may be singular.
    inverse = LinearOperator(k.shape, matvec=solver.solve, dtype=np.float64)
    start = m @ np.ones(config.size) + 1e-3 * np.sin(np.arange(config.size))
    try:
        w2, phi = eigsh(k, count, m, sigma=0.0, OPinv=inverse, v0=start)
    except ArpackError as error:
        raise CoreError(f"the modes of the structure could not be computed: {error}") from error
    order = np.argsort(w2)
    w2, phi = w2[order], phi[:, order]
    phi = phi / np.sqrt(np.einsum("ij,ij->j", phi, m @ phi))
    return np.asarray(w2), np.asarray(phi)


def least_restrained(config: SparseConfig) -> Floats | None:
    """Return the motion that the stiffness of the whole structure restrains least, if it does not.

    Each degree of freedom counts in the unit in which its own stiffness is 1, so that a rotation is
    compared with a displacement.

    Args:
        config: the part.

    Returns:
        The motion in those units, (n,), the largest entry 1; None if the stiffness is positive
        definite, apart from rounding, or the motion cannot be computed.
    """
    k = config.whole_stiffness()
    own = np.abs(k.diagonal())
    by = 1.0 / np.sqrt(np.where(own > 0.0, own, max(float(own.max(initial=0.0)), 1.0)))
    scaled = (k.multiply(by).T.multiply(by)).tocsc()
    n, rounding = scaled.shape[0], 1e-9
    if n <= _DENSE_MODES:
        values, shapes = np.linalg.eigh(scaled.toarray())
    else:
        from scipy.sparse.linalg import ArpackError, eigsh

        start = 1.0 + 1e-3 * np.sin(np.arange(n))
        try:
            # Without stiffness a motion lies next to the shift; with a negative one it need not.
            values, shapes = eigsh(scaled, 1, sigma=-rounding, v0=start)
            if values[0] > rounding:
                values, shapes = eigsh(scaled, 1, which="SA", v0=start)
        except (ArpackError, RuntimeError):
            return None
    if values[0] > rounding:
        return None
    shape = shapes[:, 0]
    return np.asarray(shape / shape[np.argmax(np.abs(shape))])


_DENSE_MODES: Final = 200
"""Number of degrees of freedom with mass up to which all modes are found at once."""


def _modes_by_flexibility(
    solver: Any, m: Any, moving: NDArray[np.intp], count: int
) -> tuple[Floats, Floats]:
    """Return the modes from the flexibility of the degrees of freedom that have mass.

    1 / omega^2 are the eigenvalues of M^1/2 K^-1 M^1/2.
    """
    own = m[moving][:, moving].toarray()
    given_way = np.column_stack([solver.solve(_unit(m.shape[0], at)) for at in moving])
    values, q = np.linalg.eigh(own)
    if values[0] <= 1e-12 * values[-1]:
        raise CoreError("the masses are not positive definite")
    root = (q * np.sqrt(values)) @ q.T
    inverse, shapes = np.linalg.eigh(root @ given_way[moving] @ root)
    inverse, shapes = inverse[::-1][:count], shapes[:, ::-1][:, :count]
    w2 = 1.0 / inverse
    # phi = omega^2 K^-1 M phi, everywhere; there M^1/2 phi = shapes.
    phi = (given_way @ (root @ shapes)) * w2
    return w2, np.asarray(phi)


def _unit(n: int, at: int) -> Floats:
    one = np.zeros(n)
    one[at] = 1.0
    return one


class Layout:
    """A part's arrays in elimination order.

    Attributes:
        order: index of the degree of freedom at each place, (n,).
        place: place of each degree of freedom, (n,).
        solver: factor of S without modal damping.
        kept: arrays that the core's pointers refer to.
    """

    def __init__(self, config: SparseConfig) -> None:
        self.config, self.kept = config, list[Any]()
        self.weights = weights = Weights.of(config.integrator, config.rho_inf)
        h = config.period_s
        self.m, self.k = config.mass_kg.matrix(), config.whole_stiffness()
        c = config.by_mass_per_s * self.m + config.by_stiffness_s * self.k
        if config.damping_n_s_per_m is not None:
            c = c + config.damping_n_s_per_m.matrix()
        in_step = weights.gamma * h * c + weights.beta * h * h * self.k
        what = "the matrix of the step: some motion has neither mass nor stiffness; it"
        self.solver = factored((1.0 - weights.alpha_m) * self.m + (1.0 - weights.alpha_f) * in_step,
                               what)  # fmt: skip
        self.first = factored(self.m + in_step, what)
        self.lower, self.d, order = self.solver.factors()
        self.order = np.asarray(order, dtype=np.int64)
        self.place = np.empty(config.size, dtype=np.int64)
        self.place[self.order] = np.arange(config.size)
        self.modal = np.zeros((config.size, 0)) if config.modal is None else config.modal
        gain = weights.gamma * h
        self.solve = self._with_modes(self.solver.solve, (1.0 - weights.alpha_f) * gain)
        self.first_solve = self._with_modes(self.first.solve, gain)

    def _with_modes(
        self, solve: Callable[[Floats], Floats], gain: float
    ) -> Callable[[Floats], Floats]:
        """Return the solution with S + gain U U', by Sherman, Morrison & Woodbury."""
        if not self.modal.shape[1]:
            return solve
        z, inner = self._modal_of(solve, gain)

        def whole(values: Floats) -> Floats:
            y = solve(values)
            return np.asarray(y - z @ (inner @ (self.modal.T @ y)))

        return whole

    def _modal_of(self, solve: Callable[[Floats], Floats], gain: float) -> tuple[Floats, Floats]:
        z = np.column_stack([solve(np.ascontiguousarray(u)) for u in self.modal.T])
        inner = np.linalg.inv(np.eye(z.shape[1]) / gain + self.modal.T @ z)
        return z, np.asarray(inner, dtype=np.float64)

    def struct(self) -> tuple[Any, Layout]:
        config, n = self.config, self.config.size
        w = self.weights
        cfg = ffi.new("rthyb_sparse_config *")
        cfg.size, cfg.interfaces, cfg.joints = n, len(config.interfaces), len(config.joints)
        cfg.modes, cfg.responses = self.modal.shape[1], len(config.responses)
        cfg.period_s = config.period_s
        cfg.alpha_m, cfg.alpha_f, cfg.gamma, cfg.beta = w.alpha_m, w.alpha_f, w.gamma, w.beta
        cfg.by_mass_per_s, cfg.by_stiffness_s = config.by_mass_per_s, config.by_stiffness_s
        self._symmetric(cfg.mass_kg, self.m)
        self._symmetric(cfg.stiffness_n_per_m, self.k)
        if config.damping_n_s_per_m is not None:
            cfg.damped = 1
            self._symmetric(cfg.damping_n_s_per_m, config.damping_n_s_per_m.matrix())
        self._factor(cfg.factor)
        panels = _panels(self.lower)
        cfg.panel, cfg.panels = self._whole(panels), len(panels) - 1
        self._modes(cfg)
        self._loads(cfg)
        self._start(cfg)
        self._rows(cfg.interface, config.interfaces)
        cfg.k_e_n_per_m = self._doubles(np.array(config.k_e_n_per_m, dtype=np.float64))
        if config.k_e_between:
            cfg.k_e_between = self._doubles(np.array(config.k_e_between, dtype=np.float64))
        self._joints(cfg)
        self._responses(cfg)
        return cfg, self

    # ---- arrays ------------------------------------------------------------------------------

    def _keep(self, ctype: str, array: NDArray[Any]) -> Any:
        array = np.ascontiguousarray(array)
        if not array.size:
            array = np.zeros(1, array.dtype)
        self.kept.append(array)
        return ffi.from_buffer(ctype, array)

    def _doubles(self, array: Floats) -> Any:
        return self._keep("double[]", np.asarray(array, dtype=np.float64).reshape(-1))

    def _whole(self, array: Any) -> Any:
        return self._keep("int32_t[]", np.asarray(array, dtype=np.int32))

    def _in_order(self, values: Floats) -> Any:
        return self._doubles(np.asarray(values)[self.order])

    def _symmetric(self, slot: Any, matrix: Any) -> None:
        sparse = _scipy_sparse()
        permuted = sparse.csr_matrix(matrix)[self.order][:, self.order]
        above = sparse.triu(permuted, 1, format="csr")
        above.sort_indices()
        slot.diagonal = self._doubles(permuted.diagonal())
        slot.start, slot.at = self._whole(above.indptr), self._whole(above.indices)
        slot.value = self._doubles(above.data)

    def _factor(self, slot: Any) -> None:
        lower = self.lower
        lower.sort_indices()
        slot.diagonal = self._doubles(1.0 / np.asarray(self.d))
        slot.start, slot.at = self._whole(lower.indptr), self._whole(lower.indices)
        slot.value = self._doubles(lower.data)

    def _modes(self, cfg: Any) -> None:
        if not self.modal.shape[1]:
            return
        gain = (1.0 - self.weights.alpha_f) * self.weights.gamma * self.config.period_s
        z, inner = self._modal_of(self.solver.solve, gain)
        cfg.modal = self._doubles(self.modal[self.order].T)
        cfg.modal_solved = self._doubles(z[self.order].T)
        cfg.modal_inner = self._doubles(inner)

    def _loads(self, cfg: Any) -> None:
        config, now = self.config, 1.0 - self.weights.alpha_f
        b = _terms_matrix(config.interfaces, config.size).toarray()
        load = np.asarray(config.load_kg, dtype=np.float64)
        cfg.load_kg = self._in_order(load)
        for name, solve, by in (("", self.solve, now), ("first_", self.first_solve, 1.0)):
            forces = np.array([-by * solve(row)[self.order] for row in b])
            setattr(cfg, f"{name}by_force", self._doubles(forces))
            setattr(cfg, f"{name}by_excitation", self._in_order(-by * solve(load)))

    def _start(self, cfg: Any) -> None:
        config, n = self.config, self.config.size
        if config.first_x_m is None and config.first_v_m_per_s is None:
            return
        x = np.zeros(n) if config.first_x_m is None else np.asarray(config.first_x_m)
        v = np.zeros(n) if config.first_v_m_per_s is None else np.asarray(config.first_v_m_per_s)
        w, h = self.weights, config.period_s
        rhs = -(config.stiffness_n_per_m.matrix() @ x) - config.damping_times(v)
        for joint in config.joints:
            e = ffi.new("rthyb_element *")
            init_element(e, joint.element)
            terms = config._between(joint.below, joint.above)
            dx, dv = (sum(by * float(s[at]) for at, by in terms) for s in (x, v))
            force = lib.rthyb_element_force(e, dx, dv, 0.0, h)
            for at, by in terms:
                rhs[at] -= by * force
        start = factored(self.m + w.beta * h * h * self.k, "the matrix of the start")
        q = start.solve(np.asarray(rhs, dtype=np.float64))
        # C adds gamma h q before it uses v, so this v is without that term.
        cfg.first_x, cfg.first_v = self._in_order(x), self._in_order(v - w.gamma * h * q)
        cfg.first_q = self._in_order(q)

    def _rows(self, slot: Any, rows: Sequence[Sequence[Term]]) -> None:
        starts = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
        slot.start = self._whole(starts)
        slot.at = self._whole([self.place[at] for row in rows for at, _ in row])
        slot.weight = self._doubles(np.array([by for row in rows for _, by in row]))

    def _joints(self, cfg: Any) -> None:
        if not self.config.joints:
            return
        array = ffi.new("rthyb_joint[]", len(self.config.joints))
        for slot, joint in zip(array, self.config.joints, strict=True):
            slot.below = GROUND if joint.below == GROUND else self.place[joint.below]
            slot.above = GROUND if joint.above == GROUND else self.place[joint.above]
            slot.stiffness_n_per_m = joint.stiffness_n_per_m
            init_element(ffi.addressof(slot, "element"), joint.element)
        self.kept.append(array)
        cfg.joint = array
        self._sliders(cfg)

    def _sliders(self, cfg: Any) -> None:
        """Lay out the joints whose friction is solved for with the step, if they are not too many.

        See sliders.c: each has its response of all degrees of freedom, and they act on each other.
        """
        at = self.config.with_dry_friction()
        if not 0 < len(at) <= SLIDERS_MAX:
            return
        config, w, h = self.config, self.weights, self.config.period_s
        across, response = self.across(at)
        cfg.sliders, cfg.slider = len(at), self._whole(at)
        cfg.slider_w = self._doubles(response[:, self.order])
        cfg.slider_g = self._doubles(w.gamma * h * across @ response.T)
        gain = (0.5 + w.gamma) * h * h
        cfg.slider_x = self._doubles(gain * config.interface_rows() @ response.T)

    def across(self, joints: Sequence[int]) -> tuple[Floats, Floats]:
        """Return B_k of joints, and (1 - alpha_f) S^-1 B_k, (joints, n) each."""
        found = (self.config.joints[i] for i in joints)
        ends = [self.config._between(joint.below, joint.above) for joint in found]
        rows = np.asarray(_terms_matrix(ends, self.config.size).toarray())
        return rows, (1.0 - self.weights.alpha_f) * np.array([self.solve(row) for row in rows])

    def _responses(self, cfg: Any) -> None:
        n, joints = self.config.size, len(self.config.joints)
        at: list[int] = []
        weights: list[float] = []
        starts = [0]
        for one in self.config.responses:
            for terms, first in ((one.joints, n), (one.interfaces, n + joints)):
                at += [first + i for i, _ in terms]
                weights += [by for _, by in terms]
            at += [int(self.place[i]) for i, _ in one.displacements]
            weights += [by for _, by in one.displacements]
            starts.append(len(at))
        slot = cfg.response
        slot.start, slot.at = self._whole(starts), self._whole(at)
        slot.weight = self._doubles(np.array(weights))


def initial_stiffness(element: ElementConfig) -> float:
    """Return the initial slope of an element's force, N/m, from a negligibly small step."""
    slot = ffi.new("rthyb_element *")
    init_element(slot, element)
    force = lib.rthyb_element_force(slot, 1e-9, 0.0, 0.0, PERIOD_S)
    slope = force / 1e-9
    return slope if math.isfinite(slope) else 0.0


def initial_damping(element: ElementConfig) -> float:
    """Return the slope of an element's force at rest over the velocity, N s/m.

    That of the direction in which it is larger.
    """
    slot = ffi.new("rthyb_element *")
    init_element(slot, element)
    slopes = (lib.rthyb_element_force(slot, 0.0, v, 0.0, PERIOD_S) / v for v in (1e-9, -1e-9))
    return float(max(slopes))
