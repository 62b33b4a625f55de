"""Numerical part, control law and specimen elements in Python, as a user would write them."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

import rthyb_rt as rt


class Oscillator(rt.NumericalPart):
    """m x'' + c x' + force = -m ag by central differences, like csrc/motion.c."""

    responses: ClassVar[dict[str, str]] = {"velocity": "m/s"}

    def __init__(self, mass_kg: float, damping_n_s_per_m: float = 0.0) -> None:
        self.m, self.c = mass_kg, damping_n_s_per_m

    def begin(self, period_s: float, k_e_n_per_m: float) -> None:
        self.h, self.x, self.x1 = period_s, 0.0, 0.0

    def answer(self, ag_mps2: float, force_n: float) -> float:
        half, net = 0.5 * self.h * self.c, -self.m * ag_mps2 - force_n
        step = (self.m - half) * (self.x - self.x1) + self.h * self.h * net
        self.x, self.x1 = self.x + step * (1.0 / (self.m + half)), self.x
        return self.x

    def report(self) -> list[float]:
        return [(self.x - self.x1) / self.h]


class Failing(Oscillator):
    """Divides by zero after a while."""

    def __init__(self, mass_kg: float, after: int = 500) -> None:
        super().__init__(mass_kg)
        self.after = after

    def answer(self, ag_mps2: float, force_n: float) -> float:
        self.after -= 1
        return super().answer(ag_mps2, force_n) / (1 if self.after else 0)


class Silly(Oscillator):
    """Returns a value that is not a displacement."""

    def __init__(self, mass_kg: float, what: str, after: int = 0) -> None:
        super().__init__(mass_kg)
        self.what_it_gives, self.left = float(what), after

    def answer(self, ag_mps2: float, force_n: float) -> float:
        x, self.left = super().answer(ag_mps2, force_n), self.left - 1
        return x if self.left >= 0 else self.what_it_gives


class Inverse(rt.ControlLaw):
    """The inverse of a first-order lag, like csrc/law_chen_ricles.c."""

    values: ClassVar[dict[str, str]] = {"alpha": "samples", "beta": "samples²", "effort": "m"}

    def __init__(self, delay_s: float, fails_at: int = 0) -> None:
        self.delay_s, self.fails_at = delay_s, fails_at

    def begin(self, period_s: float, x0_m: float, rest_noise_m: float) -> None:
        self.alpha, self.beta, self.effort, self.x1 = self.delay_s / period_s, 0.0, 0.0, x0_m

    def rest(self, x_m: float) -> None:
        self.x1 = x_m

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        self.fails_at -= 1
        if self.fails_at == 0:
            raise RuntimeError("the law has had enough")
        self.effort = self.alpha * (x_c_m - self.x1)
        self.x1 = x_c_m
        return x_c_m + self.effort


class Spring(rt.Element):
    """f = k x; counts its calls in its state."""

    def __init__(self, k_n_per_m: float) -> None:
        self.k = k_n_per_m

    def force(
        self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float, state: Any
    ) -> float:
        state[0] += 1.0
        return self.k * x_m


class Maxwell(rt.Element):
    """Spring and dashpot in series, like csrc/element.c, with all memory in its state."""

    def __init__(self, km_n_per_m: float, tau_s: float) -> None:
        self.k, self.tau = km_n_per_m, tau_s

    def force(
        self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float, state: Any
    ) -> float:
        ratio = dt_s / self.tau
        gain = -math.expm1(-ratio) / ratio if ratio > 1e-9 else 1.0
        state[1] = state[1] * math.exp(-ratio) + self.k * gain * (x_m - state[0])
        state[0] = x_m
        return float(state[1])


class Jumpy(rt.Element):
    """A spring that gives nonsense from a displacement on, in steps of time up to a length."""

    def __init__(self, what: str, from_m: float = 0.0, longest_s: float = 1.0) -> None:
        self.what_it_gives, self.from_m, self.longest_s = float(what), from_m, longest_s

    def force(
        self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float, state: Any
    ) -> float:
        if abs(x_m) >= self.from_m and dt_s <= self.longest_s:
            return self.what_it_gives
        return 6.664e5 * x_m


class Astray(rt.ControlLaw):
    """Passes the command on, and after a while something else."""

    def __init__(self, what: str, after: int = 0) -> None:
        self.what_it_gives, self.left = float(what), after

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        self.left -= 1
        return x_c_m if self.left >= 0 else self.what_it_gives


class Short(rt.ControlLaw):
    """Takes one argument too few."""

    def lead(self, x_c_m: float) -> float:  # type: ignore[override]
        return x_c_m


class Misspelt(rt.ControlLaw):
    """Has no method lead."""

    def laed(self, x_c_m: float, allowed_m: float) -> float:
        return x_c_m


class Mute(rt.ControlLaw):
    """Returns nothing."""

    def lead(self, x_c_m: float, allowed_m: float) -> None:  # type: ignore[override]
        x_c_m + allowed_m


class Unset(rt.ControlLaw):
    """Names a value that it does not have."""

    values: ClassVar[dict[str, str]] = {"gain": "1"}

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        return x_c_m


class Valued(rt.ControlLaw):
    """Passes the command on; one of its values becomes something else, -1: in begin."""

    values: ClassVar[dict[str, str]] = {"alpha": "samples", "tau_s": "s"}

    def __init__(self, name: str, what: str, after: int) -> None:
        self.name, self.what_it_gives, self.left = name, float(what), after

    def begin(self, period_s: float, x0_m: float, rest_noise_m: float) -> None:
        self.alpha = self.tau_s = 0.0
        self._perhaps()

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        self.left -= 1
        self._perhaps()
        return x_c_m

    def _perhaps(self) -> None:
        if self.left < 0:
            setattr(self, self.name, self.what_it_gives)


class Weighted(rt.ControlLaw):
    """The mean of the last commands by weights."""

    def __init__(self, weights: Any) -> None:
        self.given = weights

    def begin(self, period_s: float, x0_m: float, rest_noise_m: float) -> None:
        self.weights = np.asarray(self.given, dtype=float)
        self.last = np.full(self.weights.size, x0_m)

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        self.last = np.append(x_c_m, self.last)[: self.weights.size]
        return float(self.weights @ self.last / self.weights.sum())


class Late(Oscillator):
    """Rejects its settings when it begins."""

    def __init__(self) -> None:
        super().__init__(4220.0)

    def begin(self, period_s: float, k_e_n_per_m: float) -> None:
        raise ValueError("the mass is too large")


class Singular(rt.ControlLaw):
    """Solves equations that have no solution, by a function of NumPy."""

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        return float(np.linalg.solve(np.zeros((2, 2)), np.ones(2))[0])


class Torn(rt.Element):
    """Looks for what is not there."""

    def force(
        self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float, state: Any
    ) -> float:
        return float({}["stiffness"])


class Unnamed(rt.ControlLaw):
    """Takes any number of arguments."""

    def __init__(self, *delays_s: float) -> None:
        self.delays_s = delays_s

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        return x_c_m


class Reporting(Oscillator):
    """Reports something that is not a velocity after a while."""

    def __init__(self, what: str, after: int) -> None:
        super().__init__(4220.0)
        self.what_it_gives, self.left = float(what), after

    def report(self) -> list[float]:
        self.left -= 1
        return super().report() if self.left >= 0 else [self.what_it_gives]


class Unreported(Silly):
    """Names responses and does not return them."""

    responses: ClassVar[dict[str, str]] = {"roof": "m", "drift": "m"}
    report = rt.NumericalPart.report

    def __init__(self, mass_kg: float) -> None:
        super().__init__(mass_kg, "0")


class Unasked(rt.NumericalPart):
    """Names its responses in the object only, where nobody looks."""

    def __init__(self) -> None:
        self.responses = {"roof": "m"}  # type: ignore[misc]

    def answer(self, ag_mps2: float, force_n: float) -> float:
        return 0.0

    def report(self) -> list[float]:
        return [0.0]


class OneResponse(Oscillator):
    """Reports a number instead of a list."""

    def __init__(self) -> None:
        super().__init__(4220.0)

    def report(self) -> float:  # type: ignore[override]
        return 3.0


class Text(rt.Element):
    """Returns a word."""

    def force(self, x_m: float, v: float, a: float, dt_s: float, state: Any) -> str:  # type: ignore[override]
        return "stiff"


class ShortForce(rt.Element):
    """Takes the displacement only."""

    def force(self, x_m: float) -> float:  # type: ignore[override]
        return x_m


class Forgetful(rt.NumericalPart):
    """Has two interfaces and answers for one."""

    interfaces = 2

    def answer(self, ag_mps2: float, force_n: Any) -> list[float]:
        return [0.0]
