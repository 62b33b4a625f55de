"""Effects drawn at random: numbers from the size of the motion, the form from those of the name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from validate import laws
from validate.laws import Law
from validate.rig import Bench, Effect, Redraw
from validate.signals import Rng, rms


@dataclass(frozen=True)
class Size:
    """How the rig moves without any effect: what numbers are drawn against."""

    bench: Bench
    fine: np.ndarray
    reach: float
    speed: float
    force: float  # rms, N
    fy: float  # rms, N
    seconds: float
    f0: float
    share: float  # wanted rms of the effect over that of the force

    @property
    def h(self) -> float:
        return self.bench.dt / self.bench.sub


def sized(s: Size, kind: int, *shape: float) -> float:
    """Factor that gives a law of unit size the wanted share of the force."""
    unit = laws.along([Law("", "", kind, (1.0, *shape))], s.h, *s.fine)[0]
    level = rms(unit)
    if level <= 0:
        raise Redraw("the law does not act")
    return s.share * s.force / level


def _force(
    name: str, form: str, kind: int, p: tuple[float, ...], params: dict[str, float],
    plain: Law | None = None, scored: tuple[str, ...] | None = None,
) -> Effect:  # fmt: skip
    law = Law(name, form, kind, p)
    return Effect(name, form, params, scored=scored, law=law, plain=plain or law)


def sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def viscous(s: Size, rng: Rng) -> Effect:
    c = sized(s, laws.VISCOUS)
    if rng.random() < 0.4:
        c *= -1
    # Friction of the whole rig has to stay positive where it moves freely.
    if c < 0 and s.bench.family != "drive" and -c > 0.7 * s.bench.c:
        c = -c
    return _force("viscous", "linear", laws.VISCOUS, (c,), {"c_Ns_m": c})


def coulomb(s: Size, rng: Rng) -> Effect:
    form = str(rng.choice(["set_valued", "tanh", "prandtl_jenkins"]))
    fc = s.share * s.force
    if form == "set_valued":
        return _force("coulomb", form, laws.SGN, (fc,), {"Fc_N": fc})
    if form == "tanh":
        return _force(
            "coulomb", form, laws.TANH, (fc, s.speed * rng.uniform(0.002, 0.015)), {"Fc_N": fc}
        )
    slip = s.reach * rng.uniform(0.0005, 0.003)
    return _force("coulomb", form, laws.JENKINS, (fc, fc / slip), {"Fc_N": fc})


def stribeck(s: Size, rng: Rng) -> Effect:
    fc = s.share * s.force
    fs, vs = fc * rng.uniform(1.6, 2.6), s.speed * rng.uniform(0.06, 0.3)
    exponent = float(rng.choice([0.7, 1.0, 2.0]))
    width = float(rng.choice([0.0, 0.003 * s.speed]))
    plain = Law("", "", laws.STRIBECK, (fc, fs, vs, 2.0, 0.0))
    # Peak and width of another exponent than 2 are other numbers.
    scored = ("Fc_N", "Fs_N", "vs_m_s") if exponent == 2.0 else ("Fc_N",) if exponent == 1.0 else ()
    form = f"exponent_{exponent:g}" + ("_tanh" if width else "_set_valued")
    params = {"Fc_N": fc, "Fs_N": fs, "vs_m_s": vs}
    return _force(
        "stribeck", form, laws.STRIBECK, (fc, fs, vs, exponent, width), params, plain, scored
    )


def lugre(s: Size, rng: Rng) -> Effect:
    fc = s.share * s.force
    sigma = fc / (s.reach * rng.uniform(0.04, 0.25))
    peak = float(rng.choice([1.0, 1.25]))
    plain = Law("", "", laws.BRISTLE, (fc, sigma, fc, 1.0))
    p = (fc, sigma, peak * fc, 0.1 * s.speed)
    form = "dahl" if peak == 1.0 else "bristles_with_peak"
    return _force("lugre", form, laws.BRISTLE, p, {"Fc_N": fc, "sigma0_N_m": sigma}, plain)


def quad_damping(s: Size, rng: Rng) -> Effect:
    c2 = sized(s, laws.POWER, 2.0)
    return _force("quad_damping", "v|v|", laws.POWER, (c2, 2.0), {"c2_Ns2_m2": c2})


def inertia(s: Size, rng: Rng) -> Effect:
    m = sized(s, laws.INERTIA)
    return _force("inertia", "linear", laws.INERTIA, (m,), {"m_kg": m})


def stiffness(s: Size, rng: Rng) -> Effect:
    k = sized(s, laws.STIFFNESS) * sign(rng)
    return _force("stiffness", "linear", laws.STIFFNESS, (k,), {"dk_ratio": k / s.bench.k})


def cubic(s: Size, rng: Rng) -> Effect:
    form = str(rng.choice(["duffing", "pendulum", "wire"]))
    k3 = sized(s, laws.CUBIC)
    if form == "duffing" and rng.random() < 0.4:
        k3 = -k3
    if form == "pendulum":  # k L sin(x / L) - k x = -k x^3 / (6 L^2) + ...
        k3, length = -k3, s.reach / rng.uniform(0.4, 0.8)
        p = (6 * length**2 * -k3, length)
        plain = Law("", "", laws.CUBIC, (k3,))
        return _force("cubic", form, laws.PENDULUM, p, {"k3_N_m3": k3}, plain)
    if form == "wire":  # k x^3 / (2 L^2) - ...
        length = s.reach / rng.uniform(0.05, 0.2)
        plain = Law("", "", laws.CUBIC, (k3,))
        return _force(
            "cubic", form, laws.WIRE, (2 * length**2 * k3, length), {"k3_N_m3": k3}, plain
        )
    return _force("cubic", form, laws.CUBIC, (k3,), {"k3_N_m3": k3})


def quadratic(s: Size, rng: Rng) -> Effect:
    k2 = sized(s, laws.QUADRATIC)
    if rng.random() < 0.5:
        k2 *= sign(rng)
        return _force("quadratic", "square", laws.QUADRATIC, (k2,), {"k2_N_m2": k2})
    length = s.reach / rng.uniform(0.05, 0.2)
    plain = Law("", "", laws.QUADRATIC, (k2,))
    p = (2 * length * k2, length)
    return _force("quadratic", "exponential", laws.EXPONENTIAL, p, {"k2_N_m2": k2}, plain)


def _of_the_spring(s: Size) -> None:
    """What takes force from the elastic spring has to find one.

    Slack lies in series with what it connects, and what is lost is lost of what is there: beside a
    loop that yields neither is a part of k x, which the loop does not bear.
    """
    if s.bench.core is not None:
        raise Redraw("a spring that yields has no part of k x to lose")


def gap(s: Size, rng: Rng) -> Effect:
    _of_the_spring(s)
    k = s.bench.k_true
    g = min(1.3 * s.share * s.force / k, 0.4 * s.reach)
    if rng.random() < 0.5:
        return _force("gap", "hard", laws.GAP, (k, g), {"gap_m": g})
    plain = Law("", "", laws.GAP, (k, g))
    return _force(
        "gap", "soft", laws.GAP_SOFT, (k, g, g * rng.uniform(0.1, 0.3)), {"gap_m": g}, plain
    )


def stopper(s: Size, rng: Rng) -> Effect:
    xs = s.reach * rng.uniform(0.4, 0.75)
    ks = min(sized(s, laws.STOP, xs), 20 * s.bench.k)
    params, plain = {"ks_N_m": ks, "xs_m": xs}, Law("", "", laws.STOP, (ks, xs))
    form = str(rng.choice(["hard", "soft", "impact"]))
    if form == "hard":
        return _force("stopper", form, laws.STOP, (ks, xs), params)
    if form == "soft":
        return _force("stopper", form, laws.STOP_SOFT, (ks, xs, 0.04 * xs), params, plain)
    loss = 0.25 / s.speed
    return _force("stopper", form, laws.STOP_IMPACT, (ks, xs, loss), params, plain)


def hysteresis(s: Size, rng: Rng) -> Effect:
    _of_the_spring(s)
    k, xy = s.bench.k_true, s.reach * rng.uniform(0.25, 0.6)
    form = str(
        rng.choice(
            ["bouc_wen_1", "bouc_wen_2", "bouc_wen_5", "iwan", "menegotto_pinto", "bilinear"]
        )
    )
    unit = laws.along([Law("", "", laws.BOUC_WEN, (k, 0.0, xy, 2.0))], s.h, *s.fine)[0]
    alpha = 1 - min(s.share * s.force / max(rms(unit), 1e-9), 0.9)
    params = {"xy_m": xy, "alpha": alpha}
    plain = Law("", "", laws.BOUC_WEN, (k, alpha, xy, 2.0))
    # Where a form bends long before its asymptotes meet, the yield displacement is another number.
    sharp: tuple[str, ...] = ("xy_m", "alpha")
    if form == "iwan":
        return _force("hysteresis", form, laws.IWAN, (k, alpha, xy), params, plain, ())
    if form == "menegotto_pinto":
        return _force(
            "hysteresis",
            form,
            laws.MENEGOTTO,
            (k, alpha, xy, rng.uniform(3, 12)),
            params,
            plain,
            sharp,
        )
    if form == "bilinear":
        return _force("hysteresis", form, laws.BILINEAR, (k, alpha, xy), params, plain, sharp)
    n = float(form.rsplit("_", 1)[1])
    return _force(
        "hysteresis", form, laws.BOUC_WEN, (k, alpha, xy, n), params, plain, sharp if n > 1 else ()
    )


def pinching(s: Size, rng: Rng) -> Effect:
    if s.bench.core is None:
        raise Redraw("only a specimen that yields is pinched")
    k, alpha, xy = s.bench.core
    depth, width = rng.uniform(0.4, 0.9), rng.uniform(0.15, 0.4)
    params = {"depth": depth, "width_ratio": width}
    plain = Law("", "", laws.BOUC_PINCH, (k, alpha, xy, 2.0, depth, width, 0.0))
    if rng.random() < 0.5:
        return _force("pinching", "slope", laws.BOUC_PINCH, plain.p, params)
    p = (k, alpha, xy, 2.0, depth / (1 - depth), width, 1.0)
    return _force("pinching", "slip_lock", laws.BOUC_PINCH, p, params, plain, ())


def degradation(s: Size, rng: Rng) -> Effect:
    _of_the_spring(s)
    form = str(rng.choice(["travel", "energy", "amplitude"]))
    k, x = s.bench.k_true, s.fine[0]
    travel = float(np.abs(np.diff(x)).sum()) * rng.uniform(0.15, 0.4)
    loss = min(2.0 * s.share, 0.5)
    params = {"loss": loss, "travel_m": travel}
    plain = Law("", "", laws.DEGRADE, (k, loss, travel, 0.0))
    if form == "travel":
        return _force("degradation", form, laws.DEGRADE, plain.p, params)
    scale = travel * float(np.mean(np.abs(x))) if form == "energy" else 0.5 * s.reach
    way = 1.0 if form == "energy" else 2.0
    return _force("degradation", form, laws.DEGRADE, (k, loss, scale, way), params, plain, ())


def maxwell(s: Size, rng: Rng) -> Effect:
    tau = rng.uniform(0.3, 3.0) / (2 * math.pi * s.f0)
    km = sized(s, laws.MAXWELL, tau)
    return _force("maxwell", "exact", laws.MAXWELL, (km, tau), {"km_N_m": km, "tau_s": tau})


def second_mode(s: Size, rng: Rng) -> Effect:
    f2, zeta = s.f0 * rng.uniform(1.3, 3.0), rng.uniform(0.01, 0.06)
    m2 = sized(s, laws.SECOND_MODE, f2, zeta)
    return _force(
        "second_mode", "absorber", laws.SECOND_MODE, (m2, f2, zeta), {"m2_kg": m2, "f2_Hz": f2}
    )


def _sensor(name: str, form: str, params: dict[str, float], **sensor: float) -> Effect:
    return Effect(name, form, params, sensor=sensor)


def bias(s: Size, rng: Rng) -> Effect:
    b = s.share * s.force * sign(rng)
    return _sensor("bias", "constant", {"bias_N": b}, bias=b)


def drift(s: Size, rng: Rng) -> Effect:
    rate = 1.7 * s.share * s.force / s.seconds * sign(rng)
    return _sensor("drift", "straight", {"rate_N_s": rate}, drift=rate)


def hum(s: Size, rng: Rng) -> Effect:
    f = float(rng.choice([50.0, 60.0, 16.7])) * (1 + rng.uniform(-0.002, 0.002))
    amp = 1.4 * s.share * s.force
    return _sensor(
        "hum", "line", {"f_Hz": f, "amp_N": amp}, amp=amp, f=f, phase=rng.uniform(0, 6.28)
    )


def time_skew(s: Size, rng: Rng) -> Effect:
    skew = s.share / (2 * math.pi * s.f0) * (sign(rng) if s.bench.family != "loop" else 1.0)
    if not 4e-4 < abs(skew) < 2e-2:
        raise Redraw("no skew of a load cell")
    return _sensor("time_skew", "constant", {"skew_s": skew}, skew=skew)


def crosstalk(s: Size, rng: Rng) -> Effect:
    ratio = s.share * s.force / max(s.fy, 1e-9) * sign(rng)
    return _sensor("crosstalk", "proportional", {"ratio": ratio}, crosstalk=ratio)


def quantisation(s: Size, rng: Rng) -> Effect:
    lsb = max(3.5 * s.share * s.force, 6 * s.bench.f_noise.std)
    return _sensor("quantisation", "rounding", {"lsb_N": lsb}, lsb=lsb)


def _actuator(name: str, form: str, params: dict[str, float], **change: float | str) -> Effect:
    return Effect(name, form, params, "disp", actuator=dict(change))


def delay(s: Size, rng: Rng) -> Effect:
    assert s.bench.actuator is not None
    more = min(s.share / (2 * math.pi * s.f0), 0.012) * sign(rng)
    if more < 0 and s.bench.actuator.delay_s + more < 1e-3:
        more = -more
    return _actuator("delay", "constant", {"dtau_s": more}, delay_s=s.bench.actuator.delay_s + more)


def delay_rate(s: Size, rng: Rng) -> Effect:
    kappa = min(1.5 * s.share / (2 * math.pi * s.f0), 0.01) / s.speed
    on = "output" if s.bench.family == "loop" else str(rng.choice(["output", "smooth"]))
    return _actuator("delay_rate", on, {"kappa_s2_m": kappa}, kappa=kappa, kappa_on=on)


def act_gain(s: Size, rng: Rng) -> Effect:
    gain = 1 + min(s.share, 0.2) * sign(rng)
    return _actuator("act_gain", "constant", {"gain": gain}, gain=gain)


def oil_column(s: Size, rng: Rng) -> Effect:
    a = s.bench.actuator
    assert a is not None
    if a.kind != "second":
        raise Redraw("only a second-order actuator changes its second-order dynamics")
    f, zeta = a.f_hz * rng.uniform(0.35, 0.75), a.zeta * rng.uniform(0.4, 1.1)
    return _actuator("oil_column", "second_order", {"f_Hz": f, "zeta": zeta}, f_hz=f, zeta=zeta)


def rate_limit(s: Size, rng: Rng) -> Effect:
    vmax = s.speed * rng.uniform(0.4, 0.75)
    form = (
        "valve"
        if s.bench.actuator and s.bench.actuator.kind == "second" and rng.random() < 0.5
        else "slew"
    )
    return _actuator("rate_limit", form, {"vmax_m_s": vmax}, vmax=vmax, limit=form)


Draw = Callable[[Size, Rng], Effect]
FORCE: dict[str, Draw] = {
    f.__name__: f
    for f in (
        viscous, coulomb, stribeck, lugre, quad_damping, inertia, stiffness, cubic, quadratic, gap,
        stopper, hysteresis, pinching, degradation, maxwell, second_mode,
    )
}  # fmt: skip
SENSOR: dict[str, Draw] = {
    f.__name__: f for f in (bias, drift, hum, time_skew, crosstalk, quantisation)
}
ACTUATOR: dict[str, Draw] = {
    f.__name__: f for f in (delay, delay_rate, act_gain, oil_column, rate_limit)
}
CATALOGUE = FORCE | SENSOR | ACTUATOR


# ---- laws in no catalogue ----------------------------------------------------------------------


def stranger(s: Size, rng: Rng, name: str) -> Effect:
    """A law that has no name in the public format, of the wanted share."""
    w0 = 2 * math.pi * s.f0
    place = s.reach * rng.uniform(0.2, 0.5) * sign(rng)
    shapes: dict[str, tuple[int, tuple[float, ...]]] = {
        "magnet": (laws.MAGNET, (place, s.reach * rng.uniform(0.06, 0.15))),
        "fractional_memory": (laws.FRACTIONAL, (rng.uniform(0.3, 0.6), 0.02 / w0)),
        "parametric_stiffness": (laws.PARAMETRIC, (s.f0 * rng.uniform(0.3, 1.7),)),
        "rate_and_state": (
            laws.RATE_STATE, (0.06, rng.uniform(0.08, 0.12), 0.05 * s.speed, 0.05 * s.reach),
        ),
        "sloshing": (
            laws.SLOSH, (s.f0 * rng.uniform(0.9, 1.4), 0.01, rng.uniform(0.05, 0.2) / s.reach**2),
        ),
        "pulsed_damper": (laws.PULSED, (s.f0 * rng.uniform(0.2, 0.8),)),
        "clutch_damper": (laws.CLUTCH, ()),
    }  # fmt: skip
    kind, shape = shapes[name]
    size = sized(s, kind, *shape)
    law = Law(name, name, kind, (size, *shape))
    if not np.all(np.isfinite(laws.along([law], s.h, *s.fine))):
        raise Redraw("the law has no finite force")
    params = {"size": size} | {f"shape_{i}": v for i, v in enumerate(shape)}
    return Effect(name, name, params, scored=(), law=law)


# A dashpot of the root of velocity and a brake of eddy currents are not among them: three laws with
# a name match these to one or two per cent, so that nobody could tell.
STRANGERS = (
    "magnet", "fractional_memory", "parametric_stiffness", "rate_and_state", "sloshing",
    "pulsed_damper", "clutch_damper",
)  # fmt: skip
