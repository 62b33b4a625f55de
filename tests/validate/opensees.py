"""Recordings of specimens that OpenSees computes: driven by a machine, or on a moving ground.

python tests/validate/opensees.py --seed 7 --count 30 --out DIR

Neither the laws nor what they are made of is of this project. The model of a case has the stated
stiffness, that of first loading, and on a moving ground the mass and the dashpot.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from validate import signals
from validate.folders import table
from validate.opensees_materials import MATERIALS, Material
from validate.signals import Rng, rms

MOTIONS = ("random", "cyclic", "quake", "sweep")
RATES_HZ = (64.0, 100.0, 128.0, 200.0, 256.0, 512.0)
SHAKEN_HZ = (100.0, 128.0, 200.0, 256.0)
FINELY = 8
"""Steps of OpenSees to a row: its dampers integrate from step to step."""
SIZES = (1.0, 0.9)
"""Largest displacement of the test and of the one withheld, relative to the specimen's."""
SCALINGS = 12
"""Scales of a ground motion that are tried, until the body moves as far as wanted."""


def installed() -> bool:
    """Whether OpenSees can be loaded here: `make test-opensees` installs what it needs."""
    try:
        import openseespy.opensees  # noqa: F401 - whether it loads is all that is asked
    except (ImportError, RuntimeError):  # the latter if libraries of the system are missing
        return False
    return True


def _begun(make: Callable[[Any], None], moved: Callable[[Any], None]) -> Any:
    """OpenSees with a specimen as material 1, which joins two nodes, the first of them fixed."""
    import openseespy.opensees as ops

    ops.wipe()
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    for node in (1, 2):
        ops.node(node, 0.0)
    ops.fix(1, 1)
    make(ops)
    ops.element("zeroLength", 1, 1, 2, "-mat", 1, "-dir", 1)
    moved(ops)
    ops.numberer("Plain")
    ops.system("FullGeneral")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient", "-noWarnings")
    return ops


def _series(ops: Any, tag: int, dt: float, values: np.ndarray) -> None:
    # Beyond its last value a series is zero, and the sum of so many steps may be beyond.
    ops.timeSeries("Path", tag, "-dt", dt, "-values", *values.tolist(), float(values[-1]))


def forces(make: Callable[[Any], None], x: np.ndarray, dt: float) -> np.ndarray:
    """Force of a specimen along a motion, N, (n,); the motion from 0, one step to a row.

    Its second node is moved as a support is. A third one is there to be free, without which
    OpenSees solves nothing.
    """

    def moved(ops: Any) -> None:
        ops.node(3, 0.0)
        ops.mass(3, 1.0)
        ops.uniaxialMaterial("Elastic", 99, 1.0)
        ops.element("zeroLength", 99, 1, 3, "-mat", 99, "-dir", 1)
        _series(ops, 1, dt, x)
        _series(ops, 2, dt, np.gradient(x, dt))
        ops.pattern("MultipleSupport", 1)
        ops.groundMotion(1, "Plain", "-disp", 1, "-vel", 2)
        ops.imposedMotion(2, 1, 1)
        ops.constraints("Transformation")
        ops.algorithm("Linear")

    ops = _begun(make, moved)
    found = np.zeros(x.size)
    for i in range(1, x.size):
        _stepped(ops, dt, i, x.size)
        found[i] = ops.eleResponse(1, "material", 1, "stress")[0]
    return found


def response(
    one: Specimen, make: Callable[[Any], None], ag: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement, m, and acceleration, m/s^2, of a body relative to its ground, each (n,)."""

    def moved(ops: Any) -> None:
        ops.mass(2, one.mass_kg)
        ops.uniaxialMaterial("Viscous", 99, one.c, 1.0)
        ops.element("zeroLength", 99, 1, 2, "-mat", 99, "-dir", 1)
        _series(ops, 1, dt, ag)
        ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
        ops.constraints("Plain")
        # By displacement: a damper with a small power of velocity has no slope at rest by which
        # its force could be balanced.
        ops.test("NormDispIncr", 1e-7 * one.peak_m, 100)
        ops.algorithm("Newton")

    ops = _begun(make, moved)
    x, a = np.zeros(ag.size), np.zeros(ag.size)
    for i in range(1, ag.size):
        _stepped(ops, dt, i, ag.size)
        x[i], a[i] = ops.nodeDisp(2, 1), ops.nodeAccel(2, 1)
    return x, a


def _stepped(ops: Any, dt: float, step: int, steps: int) -> None:
    if ops.analyze(1, dt):
        raise RuntimeError(f"OpenSees fails in step {step} of {steps}")


@dataclass(frozen=True)
class Recorded:
    """One test: the columns that the laboratory has without noise, and the force, at the rows."""

    columns: dict[str, np.ndarray]
    x: np.ndarray
    f: np.ndarray


@dataclass(frozen=True)
class Specimen:
    """A material with its numbers, and what stands on it.

    Attributes:
        material: which one.
        k: initial stiffness, N/m.
        peak_m: the largest displacement of the tests, about.
        f0_hz: frequency about which they move it, or its own.
        numbers: seed of the material's numbers.
        mass_kg, c: of a body on it, and a dashpot beside it, N s/m.
    """

    material: Material
    k: float
    peak_m: float
    f0_hz: float
    numbers: int
    mass_kg: float = 0.0
    c: float = 0.0

    def built(self, v: float) -> Callable[[Any], None]:
        """What creates it, for motions of this largest velocity, m/s."""
        rng = np.random.default_rng(self.numbers)
        return lambda ops: self.material.make(ops, self.k, self.peak_m, v, rng)


def _driven(one: Specimen, kinds: list[str], fs: float, rng: Rng) -> list[Recorded]:
    """Two tests in which a machine moves the specimen, the second by less."""
    tests = [
        _motion(kind, fs, size * one.peak_m, one.f0_hz, rng)
        for kind, size in zip(kinds, SIZES, strict=True)
    ]
    v = float(np.max(np.abs(np.gradient(tests[0][1], tests[0][0]))))
    done = []
    for t, x in tests:
        f = forces(one.built(v), x, float(t[1]))[::FINELY]
        done.append(Recorded({"t": t[::FINELY]}, x[::FINELY], f))
    return done


def _motion(kind: str, fs: float, peak_m: float, f0: float, rng: Rng) -> tuple[np.ndarray, ...]:
    """Time and displacement, with so many steps to a row, from rest to rest."""
    seconds = 20.0 if kind != "cyclic" else 12.0 / f0
    t = np.arange(round(seconds * fs) * FINELY) / (fs * FINELY)
    if kind == "cyclic":  # two cycles of each amplitude, which grows within a quarter of a cycle
        cycles = f0 * t
        rise = np.clip(4.0 * (cycles[:, None] - 2.0 * np.arange(6)), 0.0, 1.0)
        x = np.sum(rise**2 * (3.0 - 2.0 * rise), axis=1) / 6.0 * np.sin(2.0 * np.pi * cycles)
    else:
        x = signals.excitation(kind, t, f0, rng)
    return t, peak_m * x * signals.ramp_in(t[-1] - t[::-1])[::-1]


def _shaken(one: Specimen, kinds: list[str], fs: float, rng: Rng) -> list[Recorded]:
    """Two tests on a moving ground, scaled until the body moves as far as wanted."""
    v = one.peak_m * 2.0 * np.pi * one.f0_hz
    done = []
    for kind, size in zip(kinds, SIZES, strict=True):
        t = np.arange(round(25.0 * fs) * FINELY) / (fs * FINELY)
        ground = signals.excitation(kind, t, one.f0_hz, rng)
        scale = one.k * one.peak_m / one.mass_kg
        for _ in range(SCALINGS):
            x, a = response(one, one.built(v), scale * ground, float(t[1]))
            ag = scale * ground
            far = float(np.max(np.abs(x))) / (size * one.peak_m)
            if 0.8 < far < 1.25:
                break
            scale *= float(np.clip(1.0 / far, 0.5, 2.0)) ** 0.8
        felt = (a + ag)[::FINELY]
        columns = {"t": t[::FINELY], "ag": ag[::FINELY], "a_meas": felt}
        done.append(Recorded(columns, x[::FINELY], -one.mass_kg * felt))
    return done


def make(number: int, seed: int) -> tuple[Specimen, dict[str, Any], list[Recorded]]:
    """A specimen, what the laboratory knows of its tests, the recording and the one withheld."""
    rng = np.random.default_rng([seed, number])
    material = MATERIALS[(number + seed) % len(MATERIALS)]
    shaken = rng.random() < 1 / 3
    fs = float(rng.choice(SHAKEN_HZ if shaken else RATES_HZ))
    f0 = float(rng.uniform(1.0, 3.0) if shaken else rng.uniform(0.5, 1.5))
    k, peak = 10 ** rng.uniform(5, 7), 10 ** rng.uniform(-2.7, -1.3)
    one = Specimen(material, k, peak, f0, int(rng.integers(2**31)))
    if shaken:
        mass = k / (2.0 * np.pi * f0) ** 2
        one = replace(one, mass_kg=mass, c=2.0 * rng.uniform(0.01, 0.04) * np.sqrt(k * mass))
        kinds = ["quake", "random"]
    else:
        kinds = [str(kind) for kind in rng.choice(MOTIONS, 2, replace=False)]
    done = (_shaken if shaken else _driven)(one, kinds, fs, rng)
    # Of a displacement transducer, a load cell, an accelerometer.
    noise = {"x": peak * 10 ** rng.uniform(-4.3, -3.5), "f": rms(done[0].f) * _little(rng)}
    if shaken:
        noise["a"] = rms(done[0].columns["a_meas"]) * _little(rng)
        if rng.random() < 0.5:
            del noise["f"]
    known = {
        "family": "ground" if shaken else "drive", "fs": fs, "k": k * rng.normal(1.0, 0.01),
        "c": one.c * rng.normal(1.0, 0.07), "kinds": kinds, "noise": noise,
        "sheet": {n: std * rng.uniform(0.85, 1.15) for n, std in noise.items()},
        "drawn": int(rng.integers(2**31)),
    }  # fmt: skip
    return one, known, done


def _little(rng: Rng) -> float:
    return float(10 ** rng.uniform(-3, -2))


def _baseline(one: Specimen, known: dict[str, Any]) -> str:
    lines = [
        'schema = "rthyb-baseline/1"', f'family = "{known["family"]}"', f"fs_hz = {known['fs']:g}",
        "", "[specimen]", f"k = {known['k']:.6g}", f"c = {known['c']:.6g}", "moving_mass = 0",
        "k_tol = 0.02",
    ]  # fmt: skip
    if one.mass_kg:
        lines += ["c_tol = 0.15", "", "[numerical]", f"m = {one.mass_kg:.7g}"]
    lines += ["", "[noise]", *(f"{n}_std = {std:.3g}" for n, std in known["sheet"].items())]
    return "\n".join(lines) + "\n"


def write(number: int, seed: int, folder: Path) -> None:
    """The folder of a case in the interchange format, its answer last."""
    one, known, (run, held) = make(number, seed)
    rng, noise = np.random.default_rng(known["drawn"]), known["noise"]
    folder.mkdir(parents=True, exist_ok=True)
    exact = run.columns | {"x_meas": run.x, "f_meas": run.f}
    measured = {}
    for name, values in exact.items():
        std = noise.get(name[0], 0.0) if name.endswith("_meas") else None
        if std is None:
            measured[name] = values
        elif std > 0.0:
            measured[name] = values + std * rng.standard_normal(values.size)
    given = {n: v for n, v in held.columns.items() if n in ("t", "ag")}
    if known["family"] == "drive":
        given["x_meas"] = held.x
    (folder / "recording.csv").write_text(table(measured))
    (folder / "heldout_input.csv").write_text(table(given))
    truth = {"t": held.columns["t"], "x": held.x, "f": held.f}
    (folder / "heldout_truth.csv").write_text(table(truth))
    (folder / "baseline.toml").write_text(_baseline(one, known))
    answer = {
        "material": one.material.name, "verdict": one.material.verdict, "family": known["family"],
        "motions": known["kinds"], "accepted": [sorted(names) for names in one.material.right],
    }  # fmt: skip
    (folder / "answer.json").write_text(json.dumps(answer, indent=1) + "\n")


def generate(seed: int, count: int, out: Path) -> Iterator[Path]:
    """Case folders, written where they are not there yet."""
    for number in range(count):
        folder = out / f"opensees_{number:03d}"
        if not (folder / "answer.json").exists():
            write(number, seed, folder)
        yield folder


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=len(MATERIALS))
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    for folder in generate(args.seed, args.count, args.out):
        print(folder, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
