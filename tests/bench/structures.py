"""Computing times of structures of many degrees of freedom, compared with dense matrices.

Run as a separate program, so that the linear algebra library is limited to one thread as well.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
STEPS = 1500


@dataclass(frozen=True)
class Times:
    """Results of one run.

    Attributes:
        frame_us: a step of the 3-D frame of 1008 degrees of freedom with 200 Bouc-Wen elements.
        dense_us: a linear step of the same frame by the printed method, with its full matrices: the
            inverse, K, C, and the three matrices of integration, by OpenBLAS in one thread.
        product_us: one such product of the six alone.
        large_us: a step of a linear 3-D frame with 3024 degrees of freedom.
        squat_us: the same number of degrees of freedom, in 12 wide storeys.
        large_mb: memory of the arrays and state of the former.
        one_us: from force to command with one degree of freedom, the call from Python included.
        answer_us: the same with 3024 degrees of freedom, in excess of that of one.
        slip_us: likewise with 32 storeys, each with steep friction, in a rough motion in which many
            begin to slip or stop at once; median of the hundredth of the ticks with the most work.
        slip_most_us: the same for the law of friction for which it is longest, a Stribeck curve.
    """

    frame_us: float
    dense_us: float
    product_us: float
    large_us: float
    squat_us: float
    large_mb: float
    one_us: float
    answer_us: float
    slip_us: float
    slip_most_us: float


def measure() -> Times:
    """Measure in a separate process."""
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(HERE / "structures.py")], env=env, capture_output=True, text=True,
        check=True, timeout=300,
    )  # fmt: skip
    return Times(**json.loads(done.stdout))


def _median_us(once: Callable[[int], object]) -> float:
    import numpy as np

    taken = []
    for i in range(STEPS):
        begun = time.perf_counter_ns()
        once(i)
        taken.append(time.perf_counter_ns() - begun)
    return float(np.median(taken)) / 1e3


def _frame(columns: tuple[int, int], storeys: int, elements: int) -> Any:
    import numpy as np
    from frames import space_frame

    from rthyb_rt import core
    from rthyb_rt.core.numerical_parts import SparsePart
    from rthyb_rt.core.sparse import GROUND, Joint, SparseConfig, Symmetric

    mass, stiffness, _, corner = space_frame(columns, storeys)
    load = np.zeros(mass.shape[0])
    load[0::6] = mass.diagonal()[0::6]
    law = core.element(
        "hysteresis", k_n_per_m=2e7, post_yield_ratio=0.05, a=1.0, b=100.0, c=100.0, eta=1.0
    )
    each = 6 * columns[0] * columns[1]
    joints = []
    for e in range(elements):
        # 168 are in every column of every storey, the others beside the first ones.
        above = 6 * (e // storeys % (columns[0] * columns[1])) + each * (e % storeys)
        joints.append(Joint(above - each if e % storeys else GROUND, above, law, 2e7))
    return SparsePart(
        SparseConfig(
            Symmetric.of(mass), Symmetric.of(stiffness), load, (((corner[0], 1.0),),), (3e7,),
            by_mass_per_s=0.3, by_stiffness_s=2e-4, joints=tuple(joints), rho_inf=0.8,
        )
    )  # fmt: skip


def _step(part: Any) -> tuple[float, float]:
    """Return the medians of `answer` and of `advance`, us."""
    x = [0.0]

    def answer(i: int) -> None:
        x[0] = part.answer(3.0 * (i % 120 - 60) / 60.0, 3e7 * x[0])[0]

    def both(i: int) -> None:
        answer(i)
        part.advance()

    whole = _median_us(both)
    return _median_us(answer), whole


def _slipping_us(law: Any) -> float:
    """Return the median of `answer` over the hundredth of the ticks with the most work."""
    import numpy as np
    from frames import shear_building

    from rthyb_rt.core.numerical_parts import SparsePart
    from rthyb_rt.core.sparse import SLIDERS_MAX, Joint, SparseConfig, Symmetric

    n = SLIDERS_MAX
    m, k = shear_building(np.full(n, 2700.0), np.full(n, 4.7e6))
    part = SparsePart(
        SparseConfig(
            Symmetric.of(m), Symmetric.of(k), np.diag(m), (((0, 1.0),),), (0.0,), by_mass_per_s=0.5,
            joints=tuple(Joint(i - 1, i, law) for i in range(n)),
        )
    )  # fmt: skip
    noise = np.random.default_rng(3).standard_normal(8 * STEPS)
    taken, work = [], []
    for i, rough in enumerate(noise):
        ag = float(10.0 * np.sin(0.02 * i) + 6.0 * rough)
        begun = time.perf_counter_ns()
        part.answer(ag, 0.0)
        taken.append(time.perf_counter_ns() - begun)
        passes, changes, law_cost, _ = part.friction_effort()
        work.append(30 * passes + 10 * changes + law_cost)
        part.advance()
    busiest = np.array(taken)[np.array(work) >= np.quantile(work, 0.99)]
    return float(np.median(busiest)) / 1e3


def main() -> None:
    """Print the times as JSON."""
    import numpy as np

    from rthyb_rt import core
    from rthyb_rt.core.numerical_parts import DensePart

    frame = _frame((3, 4), 14, 168 + 32)
    frame_answer, frame_both = _step(frame)
    n = frame.config.size
    rng = np.random.default_rng(0)
    full = [rng.normal(size=(n, n)) / n for _ in range(6)]
    inverse, k, c, *alpha = full
    x = v = a = np.ones(n)

    def dense_step(i: int) -> object:
        now = inverse @ (a - k @ x - c @ v - alpha[2] @ a)
        return x + 1e-3 * v + 1e-6 * (alpha[1] @ now), v + 1e-3 * (alpha[0] @ now)

    dense, product = _median_us(dense_step), _median_us(lambda i: inverse @ x)
    large = _frame((3, 4), 42, 0)
    large_answer, large_both = _step(large)
    _, squat_both = _step(_frame((7, 6), 12, 0))
    one = core.DenseConfig("cr", ((1e4,),), ((1e3,),), ((1e6,),), (1e4,), k_e_n_per_m=3e7)
    one_answer, _ = _step(DensePart(one))
    dry = core.element("coulomb", fc_n=2e4, width_m_per_s=1e-6)
    curve = core.element(
        "stribeck", fc_n=1.5e4, fs_n=2.4e4, vs_m_per_s=0.05, width_m_per_s=1e-6, exponent=1.3
    )
    layout = large.config.struct()[1]
    kept = sum(array.nbytes for array in layout.kept if isinstance(array, np.ndarray))
    print(
        json.dumps(
            {
                "frame_us": frame_both - frame_answer,
                "dense_us": dense,
                "product_us": product,
                "large_us": large_both - large_answer,
                "squat_us": squat_both,
                "large_mb": (kept + large.state_bytes) / 1e6,
                "one_us": one_answer,
                "answer_us": max(large_answer - one_answer, 0.0),
                "slip_us": _slipping_us(dry) - one_answer,
                "slip_most_us": _slipping_us(curve) - one_answer,
            }
        )
    )


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    main()
