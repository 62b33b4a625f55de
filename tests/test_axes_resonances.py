"""A sweep of several axes through a lightly damped resonance gives a model of their response.

The two rigs are of different kinds: servos on a reaction frame that rings, and pistons that hold
two masses on a specimen by the elastic attachments of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from rthyb_rt import config
from rthyb_rt.analysis import axes_resonances, axes_roots
from rthyb_rt.analysis.axes_resonances import Pair
from rthyb_rt.analysis.axes_roots import Axes, AxesLoop, System, constant
from rthyb_rt.analysis.linear_parts import LinearStep
from rthyb_rt.config import AxesRig
from rthyb_rt.config.axes_response import response_of_rig
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.core.sparse import SparseConfig, Symmetric
from rthyb_rt.rig import identify_axes

H = 1.0 / 1024.0
TO_AXES = np.array([[1.0, 0.2], [1.0, -0.3]])
K = np.array([[8e5, 2e4], [2e4, 6e4]])


@dataclass(frozen=True)
class Plant:
    """Axes in continuous time, x' = A x + B u, y = C x, and the natural frequencies of modes."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    modes_hz: tuple[float, ...]

    def sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the matrices of a step with held commands."""
        n, m = self.b.shape
        whole = np.zeros((n + m, n + m))
        whole[:n, :n], whole[:n, n:] = self.a * H, self.b * H
        step = pytest.importorskip("scipy.linalg").expm(whole)
        return step[:n, :n], step[:n, n:]

    def response(self, z: np.ndarray) -> np.ndarray:
        """Return readings over commands at z, (k, 2, 2)."""
        a, b = self.sampled()
        one = np.eye(len(a))
        return np.stack([self.c @ np.linalg.solve(at * one - a, b) for at in z])

    def rig(self) -> AxesRig:
        axes = "".join(f'[[axis]]\nname = "{name}"\n' for name in ("left", "right"))
        found = config.parse_any_rig(
            f'schema = "rthyb-rig/1"\n[rig]\nname = "plant"\nload_cell = "specimen"\n{axes}'
            '[kinematics]\nkind = "matrix"\ninterface = ["x", "turn"]\nrotations = ["turn"]\n'
            f"matrix = {TO_AXES.tolist()}\n[specimen]\nstiffness = {K.tolist()}\n"
            f"[plant]\na = {self.a.tolist()}\nb = {self.b.tolist()}\nc = {self.c.tolist()}\n",
            "rig.toml",
        )
        assert isinstance(found, AxesRig)
        return found

    def exact(self) -> Axes:
        """Return the axes as they are, as `axes_roots.fitted_axes` returns a model of them."""
        a, b = self.sampled()
        c = np.linalg.inv(TO_AXES) @ self.c
        moved = System(
            a, b, c, np.zeros((2, 2)), lambda z: np.linalg.inv(TO_AXES) @ self.response(z)
        )
        return Axes(moved.times(np.vstack([np.eye(2), K])), 40.0, 0.0)


def servos(damping_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B of two coupled servos of the second order."""
    w = 2.0 * np.pi * np.array([20.0, 22.0])
    a = np.block([[np.zeros((2, 2)), np.eye(2)],
                  [-np.diag(w**2), -np.diag(2.0 * damping_ratio * w)]])  # fmt: skip
    return a, np.vstack([np.zeros((2, 2)), np.diag(w**2) @ np.array([[1.0, 0.1], [0.05, 1.0]])])


def ringing_frame(natural_hz: float, damping_ratio: float) -> Plant:
    """Servos that shake their reaction frame, whose motion their sensors read as well."""
    own, drive = servos(0.7)
    w = 2.0 * np.pi * natural_hz
    a, b = np.zeros((6, 6)), np.zeros((6, 2))
    a[:4, :4], b[:4] = own, drive
    a[4, 5] = 1.0
    a[5] = [w**2, -0.6 * w**2, 0.0, 0.0, -(w**2), -2.0 * damping_ratio * w]
    c = np.hstack([np.eye(2), np.zeros((2, 4))]) + np.outer([0.3, 0.21], a[5] / w**2)
    return Plant(a, b, c, (natural_hz,))


def masses_on_attachments(damping_ratio: float) -> Plant:
    """Two masses between the attachments to their pistons and a specimen that joins them."""
    own, drive = servos(0.9)
    mass = np.diag([40.0, 40.0])
    attached, specimen = 5e5 * np.eye(2), 2e5 * np.array([[1.5, -1.0], [-1.0, 1.5]])
    square, shapes = np.linalg.eigh(np.linalg.solve(mass, attached + specimen))
    w = np.sqrt(square)
    damping = shapes @ np.diag(2.0 * damping_ratio * w) @ shapes.T
    a, b = np.zeros((8, 8)), np.zeros((8, 2))
    a[:4, :4], b[:4] = own, drive
    a[4:6, 6:8] = np.eye(2)
    a[6:8] = np.hstack([np.linalg.solve(mass, attached), np.zeros((2, 2)),
                        -shapes @ np.diag(square) @ shapes.T, -damping])  # fmt: skip
    c = np.hstack([np.zeros((2, 4)), np.eye(2), np.zeros((2, 2))])
    return Plant(a, b, c, tuple((w / (2.0 * np.pi)).tolist()))


RIGS = {
    "a reaction frame that rings at 23 Hz": ringing_frame(23.0, 0.015),
    "a reaction frame that rings at 9 Hz": ringing_frame(9.0, 0.01),
    "masses on elastic attachments": masses_on_attachments(0.02),
}


def modelled(plant: Plant) -> Axes:
    """Return the model of a rig that was identified and written to its file."""
    rig = plant.rig()
    result = identify_axes.identify_rig(rig, identify_axes.sweep_of(1e-3))
    filled = identify_axes.identified_rig(rig, result)
    assert filled.identified is not None
    found = response_of_rig(filled, filled.identified, config.STANDARD)
    axes = axes_roots.fitted_axes(filled, found, H)
    assert axes is not None
    return axes


@pytest.mark.parametrize("name", RIGS)
def test_a_sweep_through_a_light_resonance_has_a_model(name: str) -> None:
    plant = RIGS[name]
    axes = modelled(plant)
    assert axes.error < axes_roots.GOOD
    roots = np.linalg.eigvals(axes.system.a)
    # Those of the delay are all at 0.
    poles = np.log(roots[(roots.imag > 0.0) & (abs(roots) > 0.5)]) / (2.0 * np.pi * H)
    light = poles[abs(poles.real) < 0.1 * abs(poles)]
    for mode_hz in plant.modes_hz:
        assert abs(abs(light) / mode_hz - 1.0).min() < 0.03, (mode_hz, light)
    assert abs(np.linalg.eigvals(axes.system.a)).max() < 1.0
    # Between the sines of the sweep too: the peak, and the response beside it.
    f_hz = np.linspace(0.5, 40.0, 800)
    z = np.exp(2j * np.pi * f_hz * H)
    true = np.linalg.inv(TO_AXES) @ plant.response(z)
    off = abs(axes.system.response(z)[:, :2] - true).max(axis=(1, 2))
    beside = np.ones(f_hz.size, np.bool_)
    for mode_hz in plant.modes_hz:
        beside &= abs(f_hz / mode_hz - 1.0) > 0.1
    at_rest = abs(true[0]).max()
    assert off[beside].max() < 0.03 * at_rest
    peaks = [abs(r).max() for r in (axes.system.response(z)[:, :2], true)]
    assert peaks[0] == pytest.approx(peaks[1], rel=0.2)


def test_a_loop_with_a_light_resonance_is_judged_as_with_the_rig_itself() -> None:
    """Margins of the loop with the model, and with the axes as they are."""
    for plant in RIGS.values():
        axes = modelled(plant)
        m = np.diag([3e3, 400.0])
        k = np.diag([2e5, 3e4])
        part = SparseConfig(
            Symmetric.of(m), Symmetric.of(k), np.diag(m), (((0, 1.0),), ((1, 1.0),)),
            tuple(np.diag(K)), damping_n_s_per_m=Symmetric.of(0.02 * k + 6.0 * m),
            rho_inf=0.7, period_s=H, k_e_between=((0.0, K[0, 1]), (K[1, 0], 0.0)),
        )  # fmt: skip
        loops = [
            AxesLoop(
                LinearStep.of(part),
                constant(TO_AXES),
                one.system.times(np.hstack([np.zeros((2, 2)), np.eye(2)])),
                constant(np.zeros((2, 2))),
            )
            for one in (axes, plant.exact())
        ]
        gains, delays = zip(
            *((own.gain_margin(), own.delay_margin()) for own in loops), strict=True
        )
        assert 1.5 < gains[1] < 3.0
        assert gains[0] == pytest.approx(gains[1], rel=0.06)
        assert delays[0] == pytest.approx(delays[1], rel=0.02)


def test_a_pair_is_the_response_of_its_oscillator() -> None:
    """1 at rest, its peak 1 / (2 zeta sqrt(1 - zeta^2)), and the state space the same."""
    pair = Pair(8.0, 0.02)
    z = np.exp(2j * np.pi * np.linspace(0.001, 60.0, 6001) * H)
    found = pair.response(z, H)
    assert found[0, 0] == pytest.approx(1.0, abs=1e-4)
    peak = abs(found[:, 0])
    assert peak.max() == pytest.approx(25.0, rel=0.01)
    assert np.linspace(0.001, 60.0, 6001)[peak.argmax()] == pytest.approx(8.0, rel=0.01)
    block = axes_roots._Poles.of(H, 4, (pair, Pair(31.0, 0.1)))
    one = np.eye(len(block.a))
    for at, row in zip(z[::700], block.response(z[::700]), strict=True):
        direct = block.c @ np.linalg.solve(at * one - block.a, block.b)
        np.testing.assert_allclose(row, direct, rtol=1e-9, atol=1e-12)


def test_noise_is_no_resonance() -> None:
    """Servos without one, in a sweep that errs by 5 %: pairs would follow the noise."""
    own, drive = servos(0.7)
    plant = Plant(own, drive, np.hstack([np.eye(2), np.zeros((2, 2))]), ())
    f_hz = np.array(identify_axes.FREQUENCIES_HZ)
    clean = plant.response(np.exp(2j * np.pi * f_hz * H))
    rig = plant.rig()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noise = 0.05 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape))
        found = MatrixResponse(f_hz, clean + noise, np.zeros(2))
        axes = axes_roots.fitted_axes(rig, found, H)
        assert axes is not None
        assert axes.error > axes_roots.GOOD
        poles = np.linalg.eigvals(axes.system.a)
        assert not ((abs(poles.imag) > 1e-9) & (abs(poles) > 0.5)).any()


def test_a_sweep_with_few_sines_determines_fewer_resonances() -> None:
    counts = [axes_resonances.most_pairs(tones, 8) for tones in (4, 6, 8, 10, 16, 40)]
    assert counts == [0, 0, 1, 2, 3, 3]
