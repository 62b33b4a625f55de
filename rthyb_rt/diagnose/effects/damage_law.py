"""Laws of damaged members: what each of them, as one form of an effect, can say of itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Floats, Trial

CYCLES = 12.5
"""Number of full cycles whose work is the unit of loss with energy."""


class DamageLaw(ABC):
    """A law by which a member yields and degrades, and with some numbers pinches as well.

    Attributes:
        pinches: whether it is to pinch.
        variants: its variants.
        replaces: whether it may stand in place of a spring whose stiffness is stated.
        count: number of coefficients.
    """

    variants: tuple[str, ...] = ()
    replaces = False
    count = 1

    def __init__(self, pinches: bool) -> None:
        """Set whether it is to pinch."""
        self.pinches = pinches

    @abstractmethod
    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the shapes that are tried first."""

    @abstractmethod
    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Return the range of each shape parameter."""

    @abstractmethod
    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force for each coefficient of one, (n,), N."""

    @abstractmethod
    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig]:
        """Return the elements of the core."""

    @abstractmethod
    def form(self, trial: Trial) -> str:
        """Return the law by the names of its authors."""

    @abstractmethod
    def lost(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the loss of stiffness at the largest displacement, relative to the initial one."""

    @abstractmethod
    def slack(self, ctx: Context, trial: Trial) -> float:
        """Return by how much the slope is smaller around zero."""

    @abstractmethod
    def width(self, trial: Trial) -> float:
        """Return up to which part of the force or displacement it is slack."""

    def alpha(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the post-yield stiffness relative to the initial one."""
        return ctx.model.k / (ctx.model.k + float(beta[0]) * ctx.k_scale)

    def sensible(self, ctx: Context, beta: Floats) -> bool:
        """Return False if coefficients are none that nature has."""
        return True
