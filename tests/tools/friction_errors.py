"""Print the errors of structures with dry friction that docs/equations.md and docs/structures.md
state, in percent of the peak: PYTHONPATH=tests python tests/tools/friction_errors.py (4 minutes).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from test_numerical_sparse import H, of_radau, pulse, run, with_friction, worst
from test_structures import DAMPER, EXAMPLE, drift_with_damper

from rthyb_rt import config, core
from rthyb_rt.core.sparse import SparseConfig
from rthyb_rt.lab import experiment, virtual_time

ROWS = 6 * 1024
STRIBECK_ROWS = 2 * 1024
HYBRID = {
    "hybrid test, 3 samples late, alpha-beta": ["rig.actuator.delay_samples=3"],
    "hybrid test, 10 samples late, alpha-beta": [],
    "the same, robust": ["controller.type=robust"],
}
EXPONENTS, RATES = (2.0, 1.5, 1.0, 0.7), (1, 2, 4, 16)


@contextmanager
def explicit() -> Iterator[None]:
    """Evaluate dry friction at the extrapolated velocity, as other elements."""
    solved = SparseConfig.with_dry_friction
    SparseConfig.with_dry_friction = lambda _: []  # type: ignore[method-assign]
    try:
        yield
    finally:
        SparseConfig.with_dry_friction = solved  # type: ignore[method-assign]


def prepared(file: Path, changes: list[str]) -> experiment.Setup:
    """Return the example with a damper in its second storey."""
    file.write_text(EXAMPLE.read_text("utf-8") + DAMPER, encoding="utf-8")
    return experiment.prepare(*config.load_both(file, None, ["test.free_vibration_s=1", *changes]))


def whole(setup: experiment.Setup, times: int) -> core.FloatArray:
    """Return the drift of the specimen's storey, simulated with ``times`` steps per sample."""
    structure, h = setup.derived.structure, H / times
    ag = np.interp(np.arange(ROWS * times) * h, np.arange(ROWS) * H, setup.ag_mps2[:ROWS])
    finer = replace(structure, part=replace(structure.part, period_s=h))
    return finer.reference(experiment.specimen_elements(setup.rig), ag)[0][::times]


def hybrid(file: Path, changes: list[str]) -> core.FloatArray:
    """Return the same of a hybrid test."""
    rec = virtual_time.run(prepared(file, changes))
    return np.asarray(rec.samples[rec.samples["state"] == 4][:ROWS]["x_num_m"])


def of_the_building(file: Path) -> None:
    """Print the errors of the example, relative to Radau's method."""
    expected = drift_with_damper(prepared(file, []), ROWS)

    def error(found: core.FloatArray) -> str:
        return f"{100.0 * np.abs(found - expected).max() / np.abs(expected).max():8.2g}"

    print(f"{'':44}explicit  solved for")
    for times in (1, 4):
        with explicit():
            before = error(whole(prepared(file, []), times))
        after = error(whole(prepared(file, []), times))
        print(f"{f'whole building, {1024 * times} Hz':44}{before}{after}")
    for name, changes in HYBRID.items():
        with explicit():
            before = error(hybrid(file, changes))
        print(f"{name:44}{before}{error(hybrid(file, changes))}")


def of_stribeck(
    exponent: float, factor: float, rates: tuple[int, ...], fs_n: float = 2500.0, vs: float = 0.05
) -> list[float]:
    """Return the errors of four storeys in a motion ``factor`` times as large, one per rate."""
    element = core.element(
        "stribeck",
        fc_n=1500.0, fs_n=fs_n, vs_m_per_s=vs, width_m_per_s=5e-4, exponent=exponent,
    )  # fmt: skip

    def law(v: float) -> float:
        level = 1500.0 + (fs_n - 1500.0) * np.exp(-(abs(v / vs) ** exponent))
        return float(level * np.tanh(v / 5e-4))

    t, found = np.arange(STRIBECK_ROWS) * H, []
    expected = of_radau(law, t, rtol=1e-9, atol=1e-12, factor=factor)
    for times in rates:
        ag = factor * pulse(np.arange(STRIBECK_ROWS * times) * H / times)
        x = run(with_friction(element, period_s=H / times), ag, lambda i, at: np.zeros(1))
        found.append(100.0 * worst(x[::times], expected))
    return found


def main() -> None:
    """Print both tables, the range of the errors of one curve at 1024 Hz, and those of jerks."""
    with tempfile.TemporaryDirectory() as folder:
        of_the_building(Path(folder) / "damper.toml")
    print("exponent " + "".join(f"{1024 * times:8} Hz" for times in RATES))
    for exponent in EXPONENTS:
        print(f"{exponent:8g} " + "".join(f"{e:11.2g}" for e in of_stribeck(exponent, 1.0, RATES)))
    some = [of_stribeck(0.7, factor, (1,))[0] for factor in np.linspace(0.97, 1.1, 14)]
    print(f"0.7, motion times 0.97 to 1.1: {min(some):.2g} to {max(some):.2g}")
    jerks = of_stribeck(0.5, 1.0, (1, 4), fs_n=6000.0, vs=0.005)
    print("slips in jerks, 1024 and 4096 Hz: {:.2g} and {:.2g}".format(*jerks))


if __name__ == "__main__":
    main()
