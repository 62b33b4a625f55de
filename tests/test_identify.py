"""Identification: what comes out is what the virtual rig is known to be."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rthyb_rt import config, core
from rthyb_rt.config import Rate, RigFile
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.rig.identification import (
    IdentificationResult,
    SweepPlan,
    identified_rig,
    identify,
    standard_lead,
)

TABLE = "shaking-table-portal-frame"
PLATE_N_PER_M = 666400.0


def rig(name: str, **changes: str) -> RigFile:
    """A shipped rig; ``sensors__force__bias_n="5"`` changes a value."""
    overrides = {key.replace("__", "."): value for key, value in changes.items()}
    return config.load_rig(config.shipped_rig(name), overrides)


@pytest.fixture(scope="module")
def table() -> IdentificationResult:
    return identify(rig(TABLE))


def zoh_first_order(frequency_hz: float, roll_off_hz: float = 5.0) -> complex:
    """(1 - p) / (z - p) on the unit circle: a lag behind a zero-order hold."""
    z = cmath.exp(2j * math.pi * frequency_hz / core.FS_HZ)
    p = math.exp(-2 * math.pi * roll_off_hz / core.FS_HZ)
    return (1 - p) / (z - p)


# --- at other rates ------------------------------------------------------------------------------

SERVO = """schema = "rthyb-rig/1"
rig = { name = "servo", load_cell = "specimen", elastic_stiffness_n_per_m = 5e5, %s }
actuator = { kind = "second-order", natural_frequency_hz = 15, damping_ratio = 0.8 }
specimen = [{ element = "stiffness", k_n_per_m = 5e5 }, { element = "viscous", c_n_s_per_m = 900 }]
"""
TO_10_HZ = SweepPlan((0.5, 2.0, 4.0, 10.0), 1e-3)


@pytest.mark.parametrize(("hold", "half_periods"), [("zoh", 1), ("foh", 2)])
@pytest.mark.parametrize("rate_hz", [256.0, 512.0, 2048.0, 4096.0])
def test_a_rig_file_has_the_same_response_whatever_the_rate_of_the_sweep(
    rate_hz: float, hold: str, half_periods: int
) -> None:
    """A servo that holds each command, or interpolates, for a quarter to four times as long."""
    servo = config.parse_rig(SERVO % f'command_hold = "{hold}"', "servo.toml")
    known, found = identify(servo, TO_10_HZ), identify(servo, TO_10_HZ, rate=Rate(rate_hz))
    assert found.sample_rate_hz == rate_hz
    before, now = (identified_rig(servo, one).identified for one in (known, found))
    assert before is not None
    assert now is not None
    assert now.delay_at_frequency_s == pytest.approx(before.delay_at_frequency_s, abs=2e-5)
    assert now.amplitude == pytest.approx(before.amplitude, rel=2e-3)
    assert now.force_in_phase_n_per_m == pytest.approx(before.force_in_phase_n_per_m, rel=2e-3)
    # What a controller of that rate meets: later by half a period for each time it is held.
    later_s = 0.5 * half_periods * (1.0 / rate_hz - 1.0 / 1024.0)
    assert now.delay_s == pytest.approx(known.delay_s + later_s, abs=2e-5)
    assert found.alpha == pytest.approx(known.alpha + later_s * 1024.0, abs=0.06)
    assert found.k_e_n_per_m == pytest.approx(5e5, rel=2e-3)


@pytest.mark.parametrize("rate_hz", [256.0, 4096.0])
def test_lead_of_another_rate_is_the_same_lead_in_samples_of_1024_hz(rate_hz: float) -> None:
    """A pure delay of 12 ms: 1 + a s + b s^2 with a = D, b = D^2 / 2, in powers of the sample."""

    def lead(hz: float) -> tuple[float, float]:
        return 0.012 * hz, 0.5 * (0.012 * hz) ** 2 + 0.5 * 0.012 * hz

    assert standard_lead(*lead(rate_hz), Rate(rate_hz)) == pytest.approx(lead(1024.0))
    assert standard_lead(3.0, 4.0, Rate()) == (3.0, 4.0)


# --- actuators with known answers ---------------------------------------------------------------


@pytest.mark.parametrize("delay", [0, 1, 10, 17, 150, 900])
def test_pure_delay_comes_out_to_a_hundredth_of_a_sample(delay: int) -> None:
    result = identify(rig("delay-10-elastic", actuator__delay_samples=str(delay)))
    for tone in result.tones:
        assert_allclose(tone.delay_s * core.FS_HZ, delay, atol=0.005)
        assert_allclose(tone.gain, 1.0, atol=1e-9)
    assert_allclose(result.delay_s * core.FS_HZ, delay, atol=0.005)


def test_alpha_of_a_pure_delay_is_the_delay() -> None:
    result = identify(rig("delay-10-elastic"))
    assert_allclose(result.alpha, 10.0, atol=0.05)
    # Over the whole sweep the curvature term approaches alpha^2 / 2.
    assert_allclose(result.beta, 50.0, rtol=0.1)


def test_delay_too_long_for_a_phase_lead_is_said() -> None:
    result = identify(rig("delay-10-elastic", actuator__delay_samples="150"))
    assert any("a phase lead cannot compensate this actuator" in note for note in result.notes)


def test_first_order_lag_follows_its_closed_form() -> None:
    result = identify(rig("first-order-5hz"))
    for tone in result.tones:
        expected = zoh_first_order(tone.frequency_hz)
        lag_s = -cmath.phase(expected) / (2 * math.pi * tone.frequency_hz)
        assert_allclose(tone.gain, abs(expected), rtol=1e-6)
        assert_allclose(tone.delay_s, lag_s, atol=1e-7)
    p = math.exp(-2 * math.pi * 5.0 / core.FS_HZ)
    # x_m[n+1] - x_m[n] = (1 - p)(x_p[n] - x_m[n]): Eqn 2.2 with alpha = 1 / (1 - p).
    assert_allclose(result.alpha, 1 / (1 - p), atol=0.05)
    assert any("lag rather than a delay" in note for note in result.notes)


def test_second_order_actuator_follows_its_closed_form() -> None:
    text = config.dump(rig("delay-10-elastic")).replace(
        'kind = "pure-delay"\ndelay_samples = 10',
        'kind = "second-order"\nnatural_frequency_hz = 20\ndamping_ratio = 0.6\ngain = 0.97\n'
        "delay_s = 0.004",
    )
    result = identify(config.parse_rig(text))
    for tone in result.tones:
        s = 2j * math.pi * tone.frequency_hz
        w = 2 * math.pi * 20.0
        plant = 0.97 * w**2 / (s**2 + 2 * 0.6 * w * s + w**2)
        assert_allclose(tone.gain, abs(plant), rtol=2e-3)
        # The hold adds about half a sample.
        lag_s = -cmath.phase(plant) / abs(s) + 0.004
        assert_allclose(tone.delay_s, lag_s, atol=0.6 * core.PERIOD_S)


# --- the shaking table --------------------------------------------------------------------------


def test_shaking_table_has_the_papers_seventeen_samples(table: IdentificationResult) -> None:
    assert 16.5 <= table.alpha <= 17.5
    assert 16.3 <= table.delay_s * core.FS_HZ <= 17.5
    assert_allclose(next(t.gain for t in table.tones if t.frequency_hz == 2.0), 0.98, atol=0.005)


def test_elastic_stiffness_is_found_within_one_per_cent(table: IdentificationResult) -> None:
    assert_allclose(table.k_e_n_per_m, PLATE_N_PER_M, rtol=0.01)


def test_moving_mass_of_the_table_is_found(table: IdentificationResult) -> None:
    assert table.moving_mass_kg is not None
    assert_allclose(table.moving_mass_kg, 45.0, rtol=0.1)


def test_rest_noise_is_found_within_ten_per_cent(table: IdentificationResult) -> None:
    assert_allclose(table.rest_noise_m, 2e-6, rtol=0.1)
    assert_allclose(table.rest_noise_n, 5.0, rtol=0.1)


def test_friction_beside_the_specimen_is_noted(table: IdentificationResult) -> None:
    assert any("in phase with velocity" in note for note in table.notes)


def doubts(result: IdentificationResult) -> list[str]:
    return [note for note in result.notes if "sinusoidal: friction" in note]


@pytest.mark.parametrize("seed", ["1", "2", "3"])
def test_noise_of_the_load_cell_is_not_called_friction(seed: str) -> None:
    """30 N on 440 N, as a lab had it: a tenth of the force, and all of it noise."""
    noisy = rig(
        "delay-10-elastic",
        rig__seed=seed,
        specimen__0__k_n_per_m="219300",
        sensors__force__noise_std_n="30",
    )
    result = identify(noisy)
    assert_allclose(result.rest_noise_n, 30.0, rtol=0.1)
    assert doubts(result) == []
    assert max(tone.distortion for tone in result.tones) < 0.01


def test_a_load_cell_that_is_nearly_all_noise_is_no_friction_either() -> None:
    noisy = rig(
        "delay-10-elastic",
        specimen__0__k_n_per_m="219300",
        sensors__force__noise_std_n="150",
    )
    assert doubts(identify(noisy)) == []


def test_friction_is_told_behind_noise_as_large() -> None:
    """Third and higher harmonics of a square wave of 300 N: 131 N rms, beside 130 N of noise."""
    both = rig(TABLE, actuator__friction_n="300", sensors__force__noise_std_n="130")
    (note,) = doubts(identify(both))
    assert "friction" in note
    smooth = rig(TABLE, actuator__friction_n="0", sensors__force__noise_std_n="130")
    assert doubts(identify(smooth)) == []


def test_five_times_the_noise_moves_nothing_much(table: IdentificationResult) -> None:
    loud = identify(
        rig(TABLE, sensors__displacement__noise_std_m="10e-6", sensors__force__noise_std_n="20")
    )
    assert_allclose(loud.alpha, table.alpha, atol=0.05)
    assert_allclose(loud.k_e_n_per_m, table.k_e_n_per_m, rtol=1e-3)
    assert_allclose(loud.rest_noise_m, 10e-6, rtol=0.1)


def test_untared_sensors_are_reported_and_change_no_figure(table: IdentificationResult) -> None:
    result = identify(rig(TABLE, sensors__displacement__bias_m="1e-4", sensors__force__bias_n="50"))
    assert_allclose(result.offset_m, 1e-4, atol=1e-6)
    assert_allclose(result.offset_n, 50.0, atol=1.0)
    assert result.notes == table.notes  # each test begins with a tare as well
    assert_allclose(result.alpha, table.alpha, atol=1e-6)
    assert_allclose(result.k_e_n_per_m, table.k_e_n_per_m, rtol=1e-6)


def test_spring_alone_has_no_moving_mass() -> None:
    assert identify(rig("delay-10-elastic")).moving_mass_kg is None


def test_specimen_that_yields_is_called_no_spring() -> None:
    result = identify(rig("delay-10-bouc-wen"), SweepPlan.up_to(4.0, amplitude_m=0.03))
    assert result.k_e_n_per_m < 0.9 * 4737410.0
    assert any("yielding" in note for note in result.notes)


# --- rigs that cannot be identified ---------------------------------------------------------------


def test_dead_displacement_sensor_is_refused() -> None:
    dead = rig(TABLE, sensors__displacement__lsb_m="0.01")
    with pytest.raises(InputError, match=r"at 0.5 Hz the displacement did not follow .*sensor"):
        identify(dead)


@pytest.mark.parametrize("noise_n", ["0", "5"])
def test_rig_without_specimen_is_refused(noise_n: str) -> None:
    bare = rig("delay-10-elastic", specimen__0__k_n_per_m="0", sensors__force__noise_std_n=noise_n)
    with pytest.raises(InputError, match="is a specimen mounted, is the load cell connected"):
        identify(bare)


def test_load_cell_of_wrong_polarity_is_refused() -> None:
    turned = rig(TABLE, specimen__0__k_n_per_m="-666400")
    with pytest.raises(InputError, match="check the polarity of the load cell"):
        identify(turned)


@pytest.mark.parametrize(
    ("change", "name"),
    [({"sensors__displacement__range_m": "1e-3"}, "displacement"),
     ({"sensors__force__range_n": "1000"}, "force")],
)  # fmt: skip
def test_sensor_at_the_end_of_its_range_is_refused(change: dict[str, str], name: str) -> None:
    with pytest.raises(InputError, match=f"{name} sensor reached the end .* smaller amplitude"):
        identify(rig(TABLE, **change))


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        (SweepPlan((0.5, 200.0)), "frequencies 200 Hz; each must be from 0.05 to 100 Hz"),
        (SweepPlan((0.01,)), "frequencies 0.01 Hz"),
        (SweepPlan((math.nan,)), "frequencies nan Hz"),
        (SweepPlan(()), "frequencies none"),
        (SweepPlan((2.0, 1.0)), "must increase"),
        (SweepPlan(amplitude_m=0.0), "amplitude of 0 m"),
        (SweepPlan(amplitude_m=math.nan), "amplitude of nan m"),
        (SweepPlan(amplitude_m=2.0), "at most 1 m"),
    ],
)
def test_sweep_that_cannot_be_run_is_refused(sweep: SweepPlan, message: str) -> None:
    with pytest.raises(InputError, match=message):
        identify(rig("delay-10-elastic"), sweep)


# --- sweep and file ----------------------------------------------------------------------------


def test_sweep_ends_at_the_frequency_asked_for() -> None:
    assert SweepPlan.up_to(10.0) == SweepPlan()
    assert SweepPlan.up_to(2.5).frequencies_hz == (0.5, 1.0, 1.5, 2.0, 2.5)
    assert SweepPlan.up_to(0.2).frequencies_hz == (0.2,)
    assert SweepPlan.up_to(100.0).frequencies_hz[-2:] == (80.0, 100.0)


def test_sweep_stays_below_its_velocity() -> None:
    sweep = SweepPlan.up_to(100.0, amplitude_m=0.01)
    for frequency in sweep.frequencies_hz:
        assert 2 * math.pi * frequency * sweep.amplitude_at(frequency) <= 0.05 * (1 + 1e-12)


def test_a_higher_velocity_is_allowed_and_a_reduced_amplitude_is_noted() -> None:
    of_rig = rig("delay-10-elastic")
    usual = identify(of_rig, SweepPlan.up_to(8.0))
    (note,) = (text for text in usual.notes if "amplitude is less" in text)
    # 50 mm/s are 2 mm at 3.98 Hz.
    assert "from 4 Hz the amplitude is less than 2 mm, 0.995 mm at 8 Hz" in note
    assert "no sine is faster than 50 mm/s" in note
    faster = identify(of_rig, SweepPlan.up_to(8.0, 2e-3, 0.2))
    assert not [text for text in faster.notes if "amplitude is less" in text]
    assert [tone.amplitude_m for tone in faster.tones] == pytest.approx([2e-3] * 8)
    assert usual.tones[-1].amplitude_m == pytest.approx(0.05 / (2 * math.pi * 8.0))


def test_a_velocity_that_reduces_even_the_slowest_sine_is_noted_with_the_amplitude_asked_for() -> (
    None
):
    """1 mm/s is .318 mm at .5 Hz, the slowest sine."""
    for highest_hz in (5.0, 0.5):
        found = identify(rig("delay-10-elastic"), SweepPlan.up_to(highest_hz, 2e-3, 1e-3))
        (note,) = (text for text in found.notes if "amplitude is less" in text)
        assert "from 0.5 Hz the amplitude is less than 2 mm" in note
        assert f"mm at {highest_hz:g} Hz, so that no sine is faster than 1 mm/s" in note


def test_one_slow_sine_is_enough() -> None:
    result = identify(rig("delay-10-elastic"), SweepPlan.up_to(0.3))
    assert_allclose(result.k_e_n_per_m, 4737410.0, rtol=1e-6)
    assert result.moving_mass_kg is None


def test_progress_counts_to_the_end_of_the_sweep() -> None:
    seen: list[tuple[int, int]] = []
    sweep = SweepPlan.up_to(1.0)
    identify(rig("delay-10-elastic"), sweep, lambda *step: seen.append(step))
    assert seen[-1] == (sweep.ticks + 1, sweep.ticks + 1)  # one row more brings the last reading
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_identifying_twice_gives_the_same(table: IdentificationResult) -> None:
    assert identify(rig(TABLE)) == table


def test_identified_rig_reads_back_and_carries_a_test(table: IdentificationResult) -> None:
    found = identified_rig(rig(TABLE), table)
    again = config.parse_rig(config.dump(found))
    assert again == found
    assert again.identified is not None
    assert_allclose(again.identified.alpha, table.alpha, rtol=1e-4)
    assert again.identified.frequency_hz == [tone.frequency_hz for tone in table.tones]
    assert_allclose(again.rig.elastic_stiffness_n_per_m, table.k_e_n_per_m, rtol=1e-4)
    lines = config.builtin_test_path().read_text(encoding="utf-8").splitlines()
    text = "\n".join(line for line in lines if not line.startswith("alpha0"))
    test = config.parse_test(text, overrides={"test.duration_s": "8"})
    setup = experiment.prepare(test, again)
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "completed"
    assert_allclose(rec.samples["alpha"][0], table.alpha, rtol=1e-3)
    error = rec.samples["x_meas_m"] - rec.samples["x_num_m"]
    assert np.sqrt(np.mean(error**2) / np.mean(rec.samples["x_num_m"] ** 2)) < 0.02


def test_whatever_is_written_is_a_rig_file_or_refused(table: IdentificationResult) -> None:
    from dataclasses import replace

    with pytest.raises(InputError, match=r"identified\.gain"):
        identified_rig(rig(TABLE), replace(table, gain=1e-4))


def test_what_a_rig_file_leaves_out_is_said_before_it_is_written_out() -> None:
    """The file that is written has every value: no later command would know."""
    rig = config.parse_rig(
        'schema = "rthyb-rig/1"\nrig = { name = "mine", elastic_stiffness_n_per_m = 6.7e5 }\n'
        'actuator = { kind = "servo-hydraulic", moving_mass_kg = 40 }\n'
        '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 6.7e5\n'
    )
    note = identify(rig, SweepPlan.up_to(2.0)).notes[0]
    assert note.startswith('rig "mine" omits kp_per_s')
    assert "friction_n = 80" in note
    assert "moving_mass_kg" not in note
