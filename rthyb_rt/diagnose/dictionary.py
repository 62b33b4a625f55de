"""Which sets of effects may explain a force residual: singles, pairs and triples together.

All trial shapes of all effects become columns of one dictionary. Their products are stored block by
block in time, so that any set of effects can be solved, and any block held out, without reading the
rows again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.effects.base import Floats
from rthyb_rt.diagnose.gaps import Rows
from rthyb_rt.diagnose.problem import (
    Fit,
    Member,
    ResidualProblem,
    compatible,
    names_of,
    price,
)
from rthyb_rt.diagnose.refinement import slopes_of

BLOCKS = 16
"""Number of parts of a recording whose products are kept, and that are held out in turn."""


@dataclass(frozen=True)
class _Group:
    member: Member
    columns: tuple[int, ...]
    signs: str
    pinned: tuple[float | None, ...]
    count: int


@dataclass(frozen=True)
class Solved:
    """Sets of groups of one size, each solved.

    Attributes:
        chi2: of each, (m,).
        groups: of each, (m, size).
    """

    chi2: Floats
    groups: Rows

    def __len__(self) -> int:
        return self.chi2.size

    def __iter__(self) -> Iterator[tuple[float, tuple[int, ...]]]:
        return (
            (c, tuple(g)) for c, g in zip(self.chi2.tolist(), self.groups.tolist(), strict=True)
        )

    def where(self, kept: NDArray[np.bool_]) -> Solved:
        """Return a selection."""
        return Solved(self.chi2[kept], self.groups[kept])


class Dictionary:
    """All trial shapes of all effects, and their products block by block."""

    def __init__(
        self, problem: ResidualProblem, progress: Callable[[str], None] = lambda _: None
    ) -> None:
        self.problem = problem
        self.made = problem.loudness
        groups: list[_Group] = []
        columns: list[Floats] = []
        for effect in problem.effects:
            for trial in effect.trials(problem.ctx):
                member = Member(effect, trial)
                block = problem.columns(member)
                norms = np.sqrt(np.sum(block**2, axis=0))
                # No lower bound: depending on its unit, a coefficient's column may be arbitrarily
                # small.
                if not np.isfinite(norms).all() or not (norms > 0.0).any():
                    continue
                (signs, pinned), count = effect.settings(problem.ctx, trial)
                keep = [j for j in range(block.shape[1]) if norms[j] > 0]
                if keep != list(range(block.shape[1])):
                    continue
                first = len(columns)
                columns += [block[:, j] for j in keep]
                groups.append(
                    _Group(member, tuple(range(first, first + len(keep))), signs, pinned, count)
                )
            progress(effect.name)
        self.groups = groups
        self.costs = np.array([price(problem, g.member.effect, g.count) for g in groups])
        base = problem.base
        data = (
            np.column_stack([*columns, base, problem.y])
            if columns
            else np.column_stack([base, problem.y])
        )
        self.p, self.b = len(columns), base.shape[1]
        self.scale = np.sqrt(np.mean(data**2, axis=0))
        self.scale[self.scale == 0] = 1.0
        self.scale[-1] = 1.0
        data = data / self.scale
        self.cuts = np.linspace(0, data.shape[0], BLOCKS + 1).astype(int)
        self.data = data
        self.grams = np.stack([data[i:j].T @ data[i:j] for i, j in pairwise(self.cuts)])
        self.ridge = np.zeros(self.b)
        for j, nuisance in enumerate(problem.nuisances):
            if nuisance.sigma is not None:
                self.ridge[j] = 1.0 / (nuisance.sigma * self.scale[self.p + j]) ** 2
        self._pins()

    def _pins(self) -> None:
        self.pin_a, self.pin_b = np.zeros(self.p), np.zeros(self.p)
        self.pin_c = np.zeros(len(self.groups))
        for g, group in enumerate(self.groups):
            for j, sigma in zip(group.columns, group.pinned, strict=True):
                if sigma is not None:
                    s = self.scale[j]
                    self.pin_a[j] = 1.0 / (sigma * s) ** 2
                    self.pin_b[j] = 1.0 / (sigma**2 * s)
                    self.pin_c[g] += 1.0 / sigma**2

    def reduced(self, gram: Floats | None = None) -> tuple[Floats, Floats, float]:
        """Return the products after eliminating the nuisance: A, b and the sum of squares left."""
        g = self.grams.sum(axis=0) if gram is None else gram
        p, b = self.p, self.b
        bb = g[p : p + b, p : p + b] + np.diag(self.ridge + 1e-12 * g.diagonal()[p : p + b])
        cross = g[p : p + b]
        solved = np.linalg.solve(bb, cross) if b else cross
        rest = g - g[:, p : p + b] @ solved
        return rest[:p, :p], rest[:p, -1], float(rest[-1, -1])

    def beside(self, fit: Fit) -> tuple[Floats, Floats, float]:
        """Return the products after eliminating the nuisance and a set with free shapes."""
        return self.begun(fit, self.cuts[:-1])[0]

    def begun(self, fit: Fit, rows: Rows) -> list[tuple[Floats, Floats, float]]:
        """Return the same products for columns that begin at each of some rows, in order."""
        base, pins, y, extra = self._taken_out(fit)
        size = np.sqrt(np.maximum(np.sum(base**2, axis=0), 1e-200))
        base = base / size
        held = base.T @ base + np.diag(pins / size**2 + 1e-9)
        data, loudness = self.data[:, : self.p], self._loudness()
        beside = np.column_stack([base, y])
        from_base = np.linalg.solve(held, base.T @ y)
        left = float(y @ y - (base.T @ y) @ from_base) + extra
        # The products of the columns alone still contain the nuisance, which is not yet eliminated.
        gram, cross = np.zeros((self.p, self.p)), np.zeros((pins.size, self.p))
        right, end = np.zeros(self.p), y.size
        out = []
        for first in map(int, rows[::-1]):
            for part, whole in self._parts(first, end):
                own = data[part]
                if whole is None:
                    gram += (own.T @ own) / loudness**2
                else:
                    gram += self.grams[whole, : self.p, : self.p]
            # One product for nuisance, set and residual, because each reads all columns.
            products = beside[first:end].T @ data[first:end] / loudness
            cross += products[:-1]
            right += products[-1]
            end = first
            a = gram - cross.T @ np.linalg.solve(held, cross)
            out.append((a, right - cross.T @ from_base, left))
        return out[::-1]

    def _parts(self, first: int, end: int) -> Iterable[tuple[slice, int | None]]:
        """Divide a stretch of evaluated rows into blocks with known products, and the remainder."""
        inside = self.cuts[(self.cuts > first) & (self.cuts < end)]
        known = {(int(i), int(j)): b for b, (i, j) in enumerate(pairwise(self.cuts))}
        for i, j in pairwise([first, *map(int, inside), end]):
            yield slice(i, j), known.get((i, j))

    def _taken_out(self, fit: Fit) -> tuple[Floats, Floats, Floats, float]:
        """Return nuisance and set columns, their priors, the residual, and its own priors."""
        problem = self.problem
        blocks = [problem.beside(fit.members)]
        pins = [0.0 if n.sigma is None else n.sigma**-2 for n in problem.nuisances]
        y = problem.y
        extra = 0.0
        own = problem.blocks(fit.members)
        for i, (member, beta) in enumerate(zip(fit.members, fit.betas, strict=True)):
            block = own[i]
            (_, pinned), _ = member.effect.settings(problem.ctx, member.trial)
            # Relative to the fit: a coefficient fixed at one stays near it.
            y = y - block @ beta
            for b, sigma in zip(beta, pinned, strict=True):
                pins.append(0.0 if sigma is None else sigma**-2)
                extra += 0.0 if sigma is None else ((b - 1.0) / sigma) ** 2
            blocks.append(block)
        places = [(i, j) for i, m in enumerate(fit.members) for j in range(len(m.trial.theta))]
        for slope in slopes_of(problem, fit.members, own, places, fit):
            blocks.append(slope[:, None])
            pins.append(0.0)
        return np.column_stack(blocks), np.array(pins), y, extra

    def _loudness(self) -> float:
        """Return the factor by which rows were scaled down since the dictionary was created."""
        return self.problem.loudness / self.made

    def singles(self) -> Solved:
        """Return chi2 of every group alone; unphysical ones are omitted."""
        return self.sets([(g,) for g in range(len(self.groups))])

    def sets(
        self,
        sets: Sequence[tuple[int, ...]] | Rows,
        reduced: tuple[Floats, Floats, float] | None = None,
    ) -> Solved:
        """Return chi2 of sets of groups of one size; unphysical ones are omitted."""
        if len(sets) == 0:
            return Solved(np.zeros(0), np.zeros((0, 1), dtype=np.int64))
        a, b, j0 = self.reduced() if reduced is None else reduced
        width = 2
        groups = np.array(sets)
        size = groups.shape[1] * width
        index = np.full((len(self.groups), width), -1)
        sign = np.zeros((len(self.groups), width), dtype=bool)
        for g, group in enumerate(self.groups):
            index[g, : len(group.columns)] = group.columns
            sign[g, : len(group.columns)] = [s == "+" for s in group.signs]
        out: list[tuple[Floats, Rows]] = []
        aa = a + np.diag(self.pin_a)
        bb = b + self.pin_b
        for part in np.array_split(np.arange(len(sets)), max(1, len(sets) // 40000)):
            cols = index[groups[part]].reshape(part.size, size)
            there = cols >= 0
            safe = np.where(there, cols, 0)
            mat = aa[safe[:, :, None], safe[:, None, :]]
            mat = np.where(there[:, :, None] & there[:, None, :], mat, 0.0)
            diag = np.arange(size)
            mat[:, diag, diag] = np.where(there, mat[:, diag, diag] * (1 + 1e-10) + 1e-12, 1.0)
            rhs = np.where(there, bb[safe], 0.0)
            try:
                beta = np.linalg.solve(mat, rhs[:, :, None])[:, :, 0]
            except np.linalg.LinAlgError:
                beta = np.stack(
                    [np.linalg.lstsq(m, r, rcond=None)[0] for m, r in zip(mat, rhs, strict=True)]
                )
            chi2 = j0 + self.pin_c[groups[part]].sum(axis=1) - np.sum(beta * rhs, axis=1)
            positive = sign[groups[part]].reshape(part.size, size)
            bad = np.any(positive & (beta < 0), axis=1) | ~np.isfinite(chi2)
            out.append((chi2[~bad], groups[part[~bad]]))
        return Solved(*map(np.concatenate, zip(*out, strict=True)))

    def penalties(self, groups: Rows) -> Floats:
        """Return the price of each of some sets, (m, size), (m,)."""
        return np.asarray(self.costs[groups].sum(axis=1))

    def penalty(self, groups: Sequence[int]) -> float:
        """Return the price of a set: for its parameters, and for its selection among many."""
        return sum(float(self.costs[g]) for g in groups)

    def best(self, found: Solved, most: int, variants: int = 1) -> list[tuple[int, ...]]:
        """Return the best sets of groups, up to ``most`` different sets of names, in order.

        For each set of names, up to ``variants`` shapes of different variants are returned.
        """
        scores = found.chi2 + self.penalties(found.groups)
        order = np.lexsort((*found.groups.T[::-1], scores))
        kept: dict[tuple[str, ...], dict[tuple[str, ...], tuple[int, ...]]] = {}
        for groups in (tuple(row) for row in found.groups[order].tolist()):
            parts = [self.groups[g].member for g in groups]
            names = names_of(parts)
            if len(set(names)) < len(names) or not compatible(parts):
                continue
            if names not in kept and len(kept) == most:
                continue
            shapes = kept.setdefault(names, {})
            form = tuple(m.trial.variant for m in sorted(parts, key=lambda m: m.name))
            if form not in shapes and len(shapes) < variants:
                shapes[form] = groups
        return [groups for shapes in kept.values() for groups in shapes.values()]

    def pairs(self) -> Solved:
        """Return chi2 of all pairs of different effects."""
        n = len(self.groups)
        names = np.array([hash(g.member.name) for g in self.groups])
        i, j = np.triu_indices(n, 1)
        differ = names[i] != names[j]
        return self.sets(np.column_stack([i[differ], j[differ]]))

    def extended(self, seeds: Sequence[tuple[int, ...]]) -> Solved:
        """Return chi2 of the seeds with one additional effect each."""
        sets = []
        for seed in seeds:
            names = {self.groups[g].member.name for g in seed}
            sets += [
                (*seed, g) for g, group in enumerate(self.groups) if group.member.name not in names
            ]
        return self.sets(sets)
