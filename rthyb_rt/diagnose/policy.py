"""The thresholds that determine the answer of a diagnosis, in one frozen table.

Each has a unit, an origin, a description of what it decides, and the basis of its value.
`validate-policy` varies each of them and counts the answers that change: docs/diagnosis-policy.md.
Step sizes, grids and the extent of a search, which only affect its duration and resolution, are
defined where they are used; constants of a law are defined with the law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

Origin = Literal["physics", "numerics", "calibrated", "judgement"]

SIDES = 1.96
"""Half-width in standard deviations of the 95 % interval of a normal distribution."""

BY_HAND = "set by hand"
"""Basis of a value whose derivation was not documented."""


@dataclass(frozen=True)
class ThresholdEntry:
    """Description of one threshold.

    Attributes:
        unit: unit of its value; "fraction", "multiple" and "factor" are dimensionless.
        origin: "physics": follows from sensors, the interchange format or the statistics of noise;
            "numerics": from the accuracy of computed motions and forces; "calibrated": found on
            the recordings named; "judgement": chosen by the authors.
        meaning: what it decides.
        basis: justification of the value.
    """

    unit: str
    origin: Origin
    meaning: str
    basis: str


def _entry(
    value: Any, unit: str, origin: Origin, meaning: str, basis: str = BY_HAND
) -> Any:  # the type of the field it stands for
    return field(default=value, metadata={"entry": ThresholdEntry(unit, origin, meaning, basis)})


@dataclass(frozen=True)
class Policy:
    """The table; `entries` describes each field.

    Of three values, the first applies to a set of one effect, the last to three or more; see
    `of_size`.
    """

    # ---- evidence that a set of effects must contribute ----------------------------------------
    effect_price: float = _entry(
        12.0, "chi-squared", "judgement",
        "Evidence that an effect must contribute in addition to the price of its parameters, "
        "because it was selected from many.",
    )  # fmt: skip
    stated_number_price: float = _entry(
        13.0, "chi-squared", "judgement",
        "Total price of an effect that only changes a stated value, and therefore involves no "
        "selection.",
    )  # fmt: skip
    several_price: float = _entry(
        1.25, "factor", "judgement",
        "Multiple of its price that a set of several effects must earn.",
    )  # fmt: skip
    held_out_share: float = _entry(
        0.3, "fraction", "judgement",
        "Fraction of its gain that a set must keep on rows to which it was not fitted.",
    )  # fmt: skip
    least_force: float = _entry(
        1e-3, "fraction of the force", "judgement",
        "Minimum size of an effect, relative to force or displacement; a smaller one is not "
        "reported.",
    )  # fmt: skip
    needed_share: tuple[float, float, float] = _entry(
        (0.0, 4e-3, 2.5e-2), "fraction of what is explained", "judgement",
        "Minimum fraction, for a set of one, two or three effects, that each effect must explain "
        "on its own; less may be due to the form of another effect's law.",
    )  # fmt: skip
    needed_share_actuator: float = _entry(
        1.5e-3, "fraction of what is explained", "judgement",
        "The same for effects of the actuator in combination.",
    )  # fmt: skip
    estimated_motion: float = _entry(
        2.5, "factor", "judgement",
        "Factor by which the shares above and the misfits below are relaxed if the motion is "
        "estimated and therefore inaccurate.",
    )  # fmt: skip
    promising_price: float = _entry(
        0.3, "multiple of its price", "numerics",
        "Evidence that a set must contribute with its initial parameter values in order to be "
        "refined.",
    )  # fmt: skip
    promising_price_beside: float = _entry(
        0.5, "multiple of its price", "numerics",
        "The same for an effect added to a set that has already been refined.",
    )  # fmt: skip
    promising_pair: float = _entry(
        4.0, "chi-squared", "numerics",
        "Amount by which a pair, with its initial parameter values, must be better than the best "
        "single effect.",
    )  # fmt: skip
    search_ends: float = _entry(
        1.03, "chi-squared per row", "numerics",
        "If the residual of the best set exceeds this, the search continues with triples and other "
        "friction laws.",
    )  # fmt: skip

    changed_numbers: float = _entry(
        3.5, "standard deviations", "physics",
        "Maximum change of a set's parameters in one part of the recording that is attributed to "
        "chance.",
        "by chance, one in four thousand; for six parts, one in seven hundred",
    )  # fmt: skip
    changed_within: float = _entry(
        0.05, "fraction of the parameter", "judgement",
        "Standard deviation of the parameters of a law between parts of the recording that is "
        "acceptable, because specimens warm up and wear.",
        "two standard deviations are the 10 per cent within which the proof counts a parameter as "
        "correct",
    )  # fmt: skip

    # ---- choice between several sets -----------------------------------------------------------
    same_evidence: float = _entry(
        9.0, "chi-squared", "physics",
        "Sets whose evidence differs by less than this cannot be distinguished.",
        "three standard deviations of one parameter",
    )  # fmt: skip
    twin_evidence: float = _entry(
        2.0, "chi-squared", "judgement",
        "If the best set only changes a stated value, or is a single effect of the actuator, a "
        "single effect that was rejected for its higher price is reported as equally good if its "
        "chi-squared is larger by less than this.",
    )  # fmt: skip
    dearer_rival: float = _entry(
        1.5, "multiple of same_evidence", "judgement",
        "Price of each additional parameter of a rival set. A law that contains a simpler one as a "
        "special case always fits at least as well; it is a rival only if its additional parameter "
        "contributes something.",
    )  # fmt: skip
    dearer_rival_actuator: float = _entry(
        1.1, "multiple of same_evidence", "judgement",
        "The same for effects of the actuator.",
    )  # fmt: skip
    richer_friction_share: float = _entry(
        1e-3, "fraction of what is explained", "judgement",
        "Minimum fraction that a Stribeck peak or bristles must add to what dry friction explains.",
    )  # fmt: skip
    richer_friction_gain: float = _entry(
        12.0, "chi-squared", "judgement",
        "Minimum evidence beyond their price that a Stribeck peak or bristles must add, however "
        "little is explained.",
    )  # fmt: skip
    yielding_gain: float = _entry(
        25.0, "chi-squared", "judgement",
        "Evidence that bristles together with a changed stiffness must contribute beyond yielding, "
        "to which they are equivalent.",
    )  # fmt: skip
    bristles_as_lost: float = _entry(
        0.1, "fraction of the bristles' stiffness", "judgement",
        "Maximum difference between the stiffness of the bristles and the stiffness that the "
        "parallel spring lost, for both to be regarded as one yielding element.",
    )  # fmt: skip
    bristles_as_lost_tolerance: float = _entry(
        3.0, "standard deviations of the stated stiffness", "physics",
        "Additional difference permitted because of the stated tolerance of the stiffness.",
        "three standard deviations",
    )  # fmt: skip
    quick_relaxation: float = _entry(
        0.1, "rad", "judgement",
        "Product of relaxation time and angular frequency of the motion up to which relaxation is "
        "equivalent to viscous damping; ratio of the motion's frequency to that of a second mode "
        "up to which the latter is a moving mass.",
    )  # fmt: skip
    quick_beside_noise: float = _entry(
        1.0 / 3.0, "rad", "physics",
        "The same along an estimated motion, where the difference must be earned by the motion "
        "that the test imposes.",
        "a mass on a spring then acts like one that is 12 per cent larger",
    )  # fmt: skip
    form_alone: float = _entry(
        1.5e-3, "fraction of what is explained", "judgement",
        "Maximum difference between two sets that can be due to the form of a law alone; a set "
        "that leaves less than this of the force is accepted whatever the colour of the rest.",
    )  # fmt: skip
    other_form: float = _entry(
        0.03, "fraction of what is explained", "judgement",
        "Maximum loss of fit with which another form of a law still widens the confidence "
        "intervals; an effect that contributes less must earn its price beside other forms of the "
        "other laws.",
    )  # fmt: skip
    noise_reached: float = _entry(
        0.2, "fraction of the misfit", "judgement",
        "A set is considered to reach the noise level if its misfit beyond noise is at most this "
        "fraction of the other set's.",
    )  # fmt: skip
    form_seen: float = _entry(
        0.03, "misfit / noise power", "judgement",
        "Misfit beyond noise in the force of a load cell that may be due to the form of a law.",
    )  # fmt: skip
    form_moved: float = _entry(
        1.0, "misfit / noise power", "judgement",
        "The same for a simulated motion.",
    )  # fmt: skip
    form_of_rig: float = _entry(
        0.1, "misfit / noise power", "judgement",
        "The same for a rig that is simulated as a whole, where nothing amplifies a difference in "
        "form.",
    )  # fmt: skip
    refused_excess: float = _entry(
        0.3, "misfit / noise power", "judgement",
        "Misfit beyond noise above which a rejected effect is reconsidered.",
    )  # fmt: skip
    refused_price: float = _entry(
        5.0, "multiple of its price", "judgement",
        "Multiple of its price that a reconsidered effect must earn.",
    )  # fmt: skip
    drift_in_halves: float = _entry(
        0.5, "fraction of its rate", "judgement",
        "Minimum rate that a drift must have in each half of the recording, if the model states no "
        "tolerances.",
    )  # fmt: skip
    drift_cycles: float = _entry(
        2.0, "cycles", "physics",
        "Minimum number of cycles of the motion in each half for a drift, if the model states no "
        "tolerances.",
        "one cycle has a mean, and the second one shows whether it moves",
    )  # fmt: skip
    drift_unsure: float = _entry(
        0.5, "fraction of its rate", "judgement",
        "Standard deviation of that rate above which the halves are not used.",
    )  # fmt: skip
    pair_beyond_chance: float = _entry(
        1.5, "standard deviations of chi-squared", "judgement",
        "Misfit of the displacement above which pairs of actuator effects are tried.",
        "by chance, one in fifteen",
    )  # fmt: skip
    pair_excess: float = _entry(
        0.05, "misfit / noise power", "numerics",
        "The same if the model states no tolerances, and for triples.",
    )  # fmt: skip
    pair_share: float = _entry(
        2e-3, "fraction of the misfit", "numerics",
        "Additional misfit that the best set may leave in these cases (no stated tolerances, "
        "triples).",
    )  # fmt: skip
    actuator_at_noise: float = _entry(
        0.05, "misfit / noise power", "judgement",
        "Uncertainty of the estimated noise of the displacement.",
    )  # fmt: skip
    actuator_at_noise_price: float = _entry(
        2.0, "multiple of its price", "judgement",
        "Within that uncertainty, an actuator effect is exempt from the minimum share if it earns "
        "more than this multiple of its price.",
    )  # fmt: skip
    actuator_form: float = _entry(
        0.01, "fraction of its amplitude", "judgement",
        "Accuracy of the formula of an actuator's delay that grows with velocity, or of its "
        "velocity limit: beside one of them, no effect with a smaller amplitude is exempt.",
    )  # fmt: skip

    # ---- remaining misfit ----------------------------------------------------------------------
    left_stated: tuple[float, float, float] = _entry(
        (0.05, 0.015, 0.008), "fraction of the misfit", "judgement",
        "Maximum fraction that a set of one, two or three effects may leave beyond noise if the "
        "laboratory states the tolerances of its model: real laws differ in form, but several "
        "effects together fit almost anything.",
    )  # fmt: skip
    left_moved: tuple[float, float, float] = _entry(
        (0.02, 0.01, 0.005), "fraction of the misfit", "judgement",
        "The same for a simulated motion, which near resonance is an amplified image of the force.",
    )  # fmt: skip
    left_naive: float = _entry(
        0.35, "fraction of the misfit", "judgement",
        "The same for a model without stated tolerances: real specimens do not follow a law "
        "exactly.",
    )  # fmt: skip
    naive_nothing: float = _entry(
        0.2, "fraction of the force", "judgement",
        "Misfit of a freely fitted model, beyond noise, for which no effect earns its price, and "
        "which is regarded as nothing.",
    )  # fmt: skip
    refitted_from: float = _entry(
        0.5, "fraction of the stiffness", "judgement",
        "Difference of a stiffness that is stated without a tolerance from that of a line through "
        "the recording, beyond which the diagnosis begins with the line's.",
    )  # fmt: skip
    excess_as_noise: float = _entry(
        0.1, "misfit / noise power", "judgement",
        "Misfit beyond noise that is always acceptable.",
    )  # fmt: skip
    excess_of_nothing: float = _entry(
        0.15, "misfit / noise power", "judgement",
        "Additional misfit in the force that is acceptable for the model without any effect.",
    )  # fmt: skip
    at_rest: float = _entry(
        1e-3, "fraction of the largest velocity", "judgement",
        "Velocity of a simulated motion below which it is at rest: an actuator overshoots as it "
        "stops, by less than its sensor shows.",
        "at a lag of 10 Hz, a ten-thousandth of the amplitude of a motion of 1 Hz",
    )  # fmt: skip
    leftover_share: float = _entry(
        0.5, "fraction of the misfit", "judgement",
        "Maximum fraction of such a misfit that a set may leave along a motion simulated with an "
        "inexact effect of the actuator.",
        "more than half is explained",
    )  # fmt: skip
    excess_of_nothing_actuator: float = _entry(
        0.3, "misfit / noise power", "judgement",
        "The same for the displacement.",
    )  # fmt: skip
    colourless: float = _entry(
        1.5, "factor", "judgement",
        "A residual whose evidence was scaled down by less than this is considered white.",
    )  # fmt: skip
    colourless_excess: float = _entry(
        0.5, "misfit / noise power", "judgement",
        "Misfit up to which a white residual is attributed to a data sheet that understates the "
        "noise.",
    )  # fmt: skip
    coloured_evidence: float = _entry(
        1.3, "factor", "judgement",
        "Factor by which correlation between rows inflates the evidence, above which the search is "
        "repeated with the evidence scaled down.",
    )  # fmt: skip
    coloured_cell: float = _entry(
        1.3, "factor", "judgement",
        "The same, above which a load cell on moving ground is not relied on alone.",
    )  # fmt: skip
    white_residual: float = _entry(
        1.1, "factor", "judgement",
        "Inflation (`refinement.inflation`) up to which a residual is regarded as pure noise, so "
        "that no effect with an onset is looked for.",
    )  # fmt: skip
    motion_understood: float = _entry(
        1.5, "chi-squared per row", "judgement",
        "The simulated motion of the actuator's best set is regarded as the true motion if its "
        "misfit is below this.",
    )  # fmt: skip
    blur_free: float = _entry(
        0.008, "fraction of the force", "judgement",
        "Error in the force that an estimated motion of a free body may cause.",
    )  # fmt: skip
    blur_cell: float = _entry(
        0.002, "fraction of the force", "judgement",
        "The same if the force is measured by a load cell.",
    )  # fmt: skip
    within_tolerance: float = _entry(
        3.6, "standard deviations", "judgement",
        "Maximum change of a stated value with which the model is still considered correct.",
    )  # fmt: skip
    bent_number: float = _entry(
        4.0, "standard deviations", "judgement",
        "Change of a stated value (or of the mass, if the motion is estimated) at which it may be "
        "compensating for an effect.",
    )  # fmt: skip
    strained_offset: float = _entry(
        6.0, "standard deviations", "judgement",
        "Time offset beyond which it is no longer regarded as a nuisance parameter.",
    )  # fmt: skip

    # ---- simulated motions ----------------------------------------------------------------------
    moved_decisive: float = _entry(
        0.005, "fraction of the misfit", "judgement",
        "Maximum misfit of the motion with which a set is accepted in spite of the force balance.",
    )  # fmt: skip
    moved_excess: float = _entry(
        0.2, "misfit / noise power", "judgement",
        "Misfit of a motion up to which the same applies.",
    )  # fmt: skip
    motion_met: float = _entry(
        1.5, "mean square / noise power", "judgement",
        "Misfit up to which a simulated displacement is considered equal to the measured one.",
    )  # fmt: skip
    motion_met_alone: float = _entry(
        1.05, "mean square / noise power", "physics",
        "The same for a fit that cannot be improved.",
        "the noise level is not known more accurately",
    )  # fmt: skip
    motion_close: float = _entry(
        0.005, "fraction of the model's misfit", "numerics",
        "The same, as a fraction of the misfit of the model alone, because simulators of friction "
        "differ by about this much.",
    )  # fmt: skip
    simulators_differ: float = _entry(
        1.5e-4, "fraction of the displacement", "numerics",
        "Difference between two accurate simulators.",
    )  # fmt: skip
    nuisance_reach: float = _entry(
        3.0, "standard deviations", "physics",
        "Maximum adjustment of mass, time offset and force offset in a simulation.",
        "three standard deviations",
    )  # fmt: skip
    rig_follows: float = _entry(
        1.5, "mean square / noise power", "judgement",
        "Misfit up to which the motion from a simulation of the whole rig is considered the true "
        "motion.",
    )  # fmt: skip
    rig_nothing_left: float = _entry(
        1.01, "chi-squared per row", "judgement",
        "Misfit of a simulated rig below which no further effect is looked for. It is smaller than "
        "the uncertainty of the noise (3 per cent in 20 s), so that a small effect beside a large "
        "one is found.",
    )  # fmt: skip
    motion_rough: float = _entry(
        3.0, "chi-squared per row", "numerics",
        "Misfit above which a fit need not be the optimum of its kind.",
    )  # fmt: skip
    simulated_nrmse: float = _entry(
        0.012, "NRMSE", "judgement",
        "Error of a free body's simulated displacement below which no effect is considered "
        "missing.",
    )  # fmt: skip
    simulated_unseen: float = _entry(
        0.004, "NRMSE", "judgement",
        "The same in excess of the displacement noise; a larger error means that the model cannot "
        "produce this motion.",
    )  # fmt: skip
    felt_by_cell: float = _entry(
        0.05, "fraction of the misfit", "judgement",
        "A simulated motion is accepted if the misfit of the load cell, by its median over the "
        "rows, is below this.",
    )  # fmt: skip

    # ---- nuisance and noise ---------------------------------------------------------------------
    offset_prior_s: float = _entry(
        5e-5, "s", "physics",
        "Standard deviation of the time offset between channels.",
        "the interchange format: 0.1 ms is normal and not reported",
    )  # fmt: skip
    offset_normal_s: float = _entry(
        1e-4, "s", "physics",
        "Time offset of the load cell up to which it is not named.",
        "the interchange format: 0.1 ms is normal and not reported",
    )  # fmt: skip
    offset_reach_s: float = _entry(
        1.5e-4, "s", "judgement",
        "Maximum time offset of the displacement as a nuisance parameter; a large effect could "
        "otherwise overcome its prior.",
    )  # fmt: skip
    mass_blur: float = _entry(
        0.005, "fraction of the mass", "judgement",
        "Standard deviation of the mass that results from the estimation of the motion.",
    )  # fmt: skip
    noise_held: float = _entry(
        1.3, "factor", "physics",
        "The measured white noise of a channel is used only within this factor, in either "
        "direction, of the data sheet value; beyond it, the bound is used.",
        "data sheets are accurate to 20 per cent (interchange format); the margin is a judgement",
    )  # fmt: skip
    sheet_factor: float = _entry(
        1.25, "factor", "physics",
        "The noise level fitted to a residual is kept within this factor, in either direction, of "
        "the data sheet value; a residual with a larger rms is regarded as more than noise.",
        "data sheets are accurate to 20 per cent (interchange format): 1 / 0.8",
    )  # fmt: skip
    power_scatter: float = _entry(
        3.0, "standard deviations", "physics",
        "Maximum excess of the power of a residual over that of its noise, given the number of "
        "rows.",
        "three standard deviations of chi-squared",
    )  # fmt: skip
    noise_burst: float = _entry(
        1.35, "factor", "judgement",
        "Maximum ratio of the noise in any one second, or in one of the parts whose spectra are "
        "averaged, to its rms over the whole recording; more is regarded as an event.",
    )  # fmt: skip
    noise_beside_motion: float = _entry(
        0.01, "fraction of the motion's power", "judgement",
        "Fraction of the motion's power (by velocity) that may lie outside its band, half at each "
        "end.",
    )  # fmt: skip
    noise_room: float = _entry(
        0.25, "sampling rates", "judgement",
        "Upper end of the motion's band above which too little of the spectrum is left to "
        "determine the noise.",
    )  # fmt: skip
    noise_steepest: float = _entry(
        2.0, "power of 1 / f", "physics",
        "Maximum steepness of the noise spectrum towards low frequencies.",
        "a random walk",
    )  # fmt: skip
    noise_near: float = _entry(
        4.0, "factor", "judgement",
        "Multiple of the upper end of the motion's band up to which the noise is representative of "
        "that within the band.",
    )  # fmt: skip
    noise_line: float = _entry(
        6.0, "factor", "physics",
        "Multiple of the noise level at which the power of a spectral line is capped.",
        "by chance, one in 400 exceeds it",
    )  # fmt: skip
    noise_spectra: int = _entry(
        6, "parts", "numerics",
        "Minimum number of segments of a recording needed to distinguish the noise of a sensor "
        "from what other channels show as well.",
        "overlapping by half, they give eleven; by chance, one other channel accounts for a tenth "
        "of a line",
    )  # fmt: skip
    noise_part_s: float = _entry(
        2.0, "s", "numerics",
        "Maximum length of these segments.",
        "a frequency resolution of 0.5 Hz",
    )  # fmt: skip
    noise_independent: float = _entry(
        0.9, "spectra", "judgement",
        "Effective number of independent spectra per segment.",
        "0.997 for white noise, by the formula for segments that overlap by half with this window "
        "(Welch 1967); less for coloured noise",
    )  # fmt: skip
    noise_shared: float = _entry(
        0.2, "fraction of a line's power", "judgement",
        "Maximum fraction of a noise line that other channels may show.",
        "a fraction of this size increases the noise by a quarter",
    )  # fmt: skip
    noise_moves: float = _entry(
        0.5, "fraction of a line's power", "physics",
        "If other channels show more than this fraction of a line, it is regarded as motion.",
    )  # fmt: skip
    noise_neighbours: int = _entry(
        3, "lines", "numerics",
        "Number of lines on each side over which that fraction is averaged.",
        "a single line may coincide by chance",
    )  # fmt: skip
    noise_rows: float = _entry(
        0.5, "fraction of the rows", "judgement",
        "Minimum fraction of the rows that must be usable to determine the colour of the noise.",
    )  # fmt: skip
    slow_lines_power: float = _entry(
        2.5, "multiple of the noise power", "physics",
        "Mean power of the slowest lines of a residual above which a constant force or a drift is "
        "compared with them; likewise of the lines near that of a hum.",
        "by chance, one in a hundred for eight lines of white noise, 5e-6 for thirty-two",
    )  # fmt: skip
    hangs_together: float = _entry(
        0.05, "correlation", "numerics",
        "Correlation of a residual below which later rows are considered independent.",
    )  # fmt: skip
    force_accuracy: float = _entry(
        0.004, "fraction of the force", "judgement",
        "Best accuracy with which the free motion of a body determines the force.",
    )  # fmt: skip
    abrupt_model: float = _entry(
        0.3, "standard deviations of noise", "physics",
        "Rows are evaluated only if, over a normal time offset, the force deviates from a straight "
        "line by less than this.",
        "it increases the noise power by less than a tenth",
    )  # fmt: skip
    abrupt_rows: float = _entry(
        0.9, "fraction of the rows", "judgement",
        "Minimum fraction of rows that must remain if rows with a larger deviation are excluded; "
        "if the motion is abrupt throughout, all rows are used.",
    )  # fmt: skip
    hum_line: float = _entry(
        6.0, "factor", "judgement",
        "Ratio of a spectral line to its surroundings above which it is tried as hum.",
    )  # fmt: skip
    hum_apart: float = _entry(
        0.02, "fraction of the largest line", "judgement",
        "Line of the model's force above which a line of the residual at the same frequency is "
        "attributed to the motion.",
    )  # fmt: skip
    faint_force: float = _entry(
        0.1, "fraction of the noise", "judgement",
        "Size of a force at a given frequency below which it carries no information on time "
        "offsets.",
    )  # fmt: skip
    abrupt_force: float = _entry(
        3.0, "factor", "judgement",
        "An effect's force is regarded as abrupt if its share at frequencies at which the model's "
        "force has faded into the noise exceeds the model's share there by this factor.",
    )  # fmt: skip

    # ---- quantisation of a coarse load cell -----------------------------------------------------
    coarse_readings: float = _entry(
        0.5, "fraction of the rows", "judgement",
        "Fraction of distinct readings above which a load cell is not considered coarse.",
    )  # fmt: skip
    coarse_on_grid: float = _entry(
        0.98, "fraction of the readings", "judgement",
        "Fraction of readings that must lie on one grid.",
    )  # fmt: skip
    coarse_near: float = _entry(
        0.15, "rad", "judgement",
        "Maximum distance of a reading from the grid, as a phase: one grid step is 2 pi.",
    )  # fmt: skip
    coarse_undithered: float = _entry(
        4.0, "multiple of the noise", "physics",
        "Step of a load cell above which its rounding is no noise: the force is evaluated where "
        "the reading changes.",
        "two neighbouring changes are then four standard deviations apart",
    )  # fmt: skip
    coarse_change: float = _entry(
        0.25, "changes per row", "judgement",
        "Maximum number of such changes; a force that passes more steps is evaluated in every row.",
    )  # fmt: skip
    coarse_flicker: float = _entry(
        6.0, "standard deviations of noise", "physics",
        "Change of the force within which noise makes a reading change back and forth.",
        "three standard deviations to either side",
    )  # fmt: skip
    coarse_near_end: float = _entry(
        2.0, "standard deviations of noise", "numerics",
        "Distance of a force from the end of a step up to which its reading is evaluated once a "
        "set is known.",
        "further inside, a row has less than a fifth of the weight of one at the end",
    )  # fmt: skip
    coarse_settled: float = _entry(
        0.3, "standard deviations of noise", "numerics",
        "Change of the best set's force, rms, below which the readings of a coarse load cell are "
        "not evaluated again.",
    )  # fmt: skip
    coarse_odds: float = _entry(
        2.0, "multiple of the least value", "judgement",
        "Deviance from the readings of a coarse load cell above which a set is rejected: it was "
        "not fitted to them, but where they change.",
    )  # fmt: skip
    rounded_rows: float = _entry(
        0.02, "fraction of the rows", "judgement",
        "The model alone is accepted if at most this fraction of the rows deviates by more than "
        "half a quantisation step plus noise; likewise dry friction, if the force in rows at rest "
        "exceeds its level.",
    )  # fmt: skip
    rounded_noise: float = _entry(
        3.0, "standard deviations of noise", "physics",
        "Deviation beyond half a quantisation step that is attributed to noise.",
        "three standard deviations",
    )  # fmt: skip
    rounded_outside: float = _entry(
        0.002, "fraction of the rows", "judgement",
        "Fraction of rows that may deviate by more than quantisation explains, whatever set is "
        "named.",
    )  # fmt: skip
    rounded_as_best: float = _entry(
        5.0, "multiple of the best set's value", "judgement",
        "If a set of effects was found, the model alone is accepted only if the number of its rows "
        "that quantisation cannot explain is below this multiple of the set's number.",
    )  # fmt: skip
    rounded_gain: float = _entry(
        400.0, "chi-squared", "judgement",
        "Evidence beyond its price above which a set explains more than quantisation.",
    )  # fmt: skip
    rounded_excess: float = _entry(
        0.25, "misfit / noise power", "judgement",
        "Misfit that such a set may leave.",
    )  # fmt: skip
    rounded_better: float = _entry(
        0.2, "multiple of the best set's value", "judgement",
        "A set takes precedence over the set with the lowest chi-squared if the number of rows "
        "that quantisation cannot explain is below this multiple of that set's number.",
    )  # fmt: skip
    rounded_alike: float = _entry(
        2.0, "multiple of the best set's value", "judgement",
        "A subset or a rival of the best set is regarded as equally good if its number of such "
        "rows is below this multiple of that set's number.",
    )  # fmt: skip

    # ---- effects with an onset, and recordings that start during motion -------------------------
    absent_before: float = _entry(
        0.5, "fraction of its later size", "physics",
        "Maximum size of an effect before its onset.",
        "halfway between an effect that is absent and one that is present throughout",
    )  # fmt: skip
    absent_sure: float = _entry(
        2.0, "standard deviations", "physics",
        "Confidence with which its absence must be established.",
        "two standard deviations",
    )  # fmt: skip
    same_moment: float = _entry(
        1.0 / 16.0, "fraction of the recording", "numerics",
        "Maximum time between the onsets of two effects of a set: they are one event.",
        "the interval between the onsets that are tried first",
    )  # fmt: skip
    start_at_rest: float = _entry(
        0.02, "fraction of the largest displacement", "judgement",
        "A body is at rest if it moves by less than this in a tenth of a second.",
    )  # fmt: skip
    motion_from_hz: float = _entry(
        0.3, "Hz", "numerics",
        "Frequency below which displacement is not compared with accelerations.",
        "below it, the window over the recording and a drifting offset resemble motion",
    )  # fmt: skip
    accelerometer_from_hz: float = _entry(
        0.2, "Hz", "numerics",
        "Frequency above which an accelerometer is used to determine the displacement.",
    )  # fmt: skip
    motion_clear: float = _entry(
        3.5, "multiple of the noise power", "judgement",
        "Power above which a line of a smoothed spectrum is regarded as motion.",
    )  # fmt: skip
    corner_isolated: float = _entry(
        5.0, "multiple of the bends two and three rows away", "numerics",
        "Bend of a displacement in a row from which it is a corner that the rows do not resolve.",
        "that of a sine is 4.2 at most, at whatever number of rows a cycle",
    )  # fmt: skip
    corner_noise: float = _entry(
        20.0, "standard deviations of the noise", "numerics",
        "The same bend: a second difference of noise reaches 2.5 standard deviations times 5.",
    )  # fmt: skip
    coarse_told: float = _entry(
        2.0, "standard deviations of the data sheet's noise", "physics",
        "Step of a load cell from which its resolution is a finding.",
        "rounding to 2 standard deviations makes noise 15 per cent louder; a sheet is right within "
        "20 (interchange format)",
    )  # fmt: skip
    static_hz: float = _entry(
        50.0, "Hz", "judgement",
        "Sample rate up to which a model without rate-dependent terms may belong to a quasi-static "
        "test.",
    )  # fmt: skip
    static_rate_noise: float = _entry(
        0.02, "fraction of the median rate", "judgement",
        "Noise of the velocity in such a test above which rows near reversals are not evaluated.",
    )  # fmt: skip
    static_straight: float = _entry(
        0.3, "fraction of the rows", "judgement",
        "Fraction of straight strokes above which such a test is regarded as consisting of ramps.",
    )  # fmt: skip
    static_rows: float = _entry(
        0.5, "fraction of the rows", "judgement",
        "Minimum fraction of rows that must remain if rows near reversals are excluded.",
    )  # fmt: skip
    static_apart: float = _entry(
        4.0, "standard deviations", "physics",
        "Difference above which two displacements are regarded as different.",
        "by chance, six in a hundred thousand",
    )  # fmt: skip
    stroke_straight: float = _entry(
        1.25, "multiple of its noise", "judgement",
        "Maximum rms deviation of a straight stroke from a line.",
    )  # fmt: skip
    stroke_bent: float = _entry(
        4.0, "standard deviations", "physics",
        "Maximum deviation of the mean over a third of the stroke from that line.",
        "by chance, six in a hundred thousand",
    )  # fmt: skip
    stroke_rests: float = _entry(
        5.0, "standard deviations", "physics",
        "Slope of a stroke below which it is at rest.",
        "by chance, one in two million",
    )  # fmt: skip
    command_at_rest: float = _entry(
        1e-3, "fraction of the largest command", "judgement",
        "Maximum command of an actuator that is regarded as at rest.",
    )  # fmt: skip
    moving_at_start: float = _entry(
        0.02, "fraction of the largest velocity", "judgement",
        "Velocity in the first hundredth of a second, beyond noise, above which an actuator was "
        "already moving.",
    )  # fmt: skip
    forgotten_force: float = _entry(
        0.3, "standard deviations of noise", "judgement",
        "Difference between two forces below which they are equal, so that a yielding model no "
        "longer depends on its initial state.",
        "it increases the noise power by less than a tenth",
    )  # fmt: skip
    forgotten_by: float = _entry(
        0.4, "fraction of the recording", "judgement",
        "Maximum part of the recording that is skipped for this; otherwise all of it is evaluated.",
    )  # fmt: skip
    past_better: float = _entry(
        0.5, "fraction of the misfit", "judgement",
        "An assumed loading history, or a motion simulated anew, is accepted if it reduces the "
        "misfit in the first rows of a second recording to at most this fraction.",
    )  # fmt: skip

    # ---- redundant channels, and channels unknown to the model ----------------------------------
    accelerometer_gain: float = _entry(
        0.02, "fraction", "physics",
        "Maximum difference in gain between an accelerometer and the second derivative of the "
        "displacement.",
        "each sensor is calibrated to one per cent",
    )  # fmt: skip
    accelerometer_late_s: float = _entry(
        2e-4, "s", "physics",
        "Maximum difference in time between them.",
        "an error of 0.1 ms per channel is normal",
    )  # fmt: skip
    accelerometer_clear: float = _entry(
        10.0, "multiple of its noise", "physics",
        "Ratio of a frequency's power to its noise needed to determine the gain and the time "
        "difference.",
        "its bias is then at most one per cent",
    )  # fmt: skip
    accelerometer_sure: float = _entry(
        3.0, "standard deviations", "physics",
        "Confidence with which a larger difference must be established.",
        "three standard deviations",
    )  # fmt: skip
    modulation_channels: int = _entry(
        4, "channels", "numerics",
        "Maximum number of channels unknown to the model that are tried; with more, chance "
        "findings become likely and the search takes hours.",
    )  # fmt: skip
    modulation_shifts: int = _entry(
        19, "shifts", "physics",
        "Number of time shifts, in each direction, of such a channel that must all give a smaller "
        "gain.",
        "a permutation test: by chance, 1 in 39",
    )  # fmt: skip
    modulation_share: float = _entry(
        4e-3, "fraction of what is explained", "judgement",
        "Minimum fraction that a modulation must add if the model states no tolerances.",
        "as `needed_share` for two effects",
    )  # fmt: skip
    modulation_own: float = _entry(
        0.5, "fraction of its coefficient", "judgement",
        "Minimum coefficient of that part of a channel that does not follow from the motion.",
    )  # fmt: skip
    modulation_alone: float = _entry(
        1e-6, "fraction of its variance", "numerics",
        "Minimum variance of a channel that must remain after removing what follows from the "
        "motion.",
    )  # fmt: skip
    modulation_turned: float = _entry(
        -0.1, "fraction of its mean", "judgement",
        "If a law's coefficient must be positive, the most negative value that it may reach during "
        "the recording.",
    )  # fmt: skip

    # ---- laws -----------------------------------------------------------------------------------
    spring_level: float = _entry(
        0.01, "fraction of the steepest slope", "numerics",
        "Together with a yielding law, a spring may be flat; it is regarded as falling, and is "
        "rejected, if its slope is more negative than this.",
    )  # fmt: skip
    dashpot_level: float = _entry(
        0.01, "fraction of the relaxing force", "numerics",
        "Beside relaxation, the dashpot of a naive model may be zero; it is regarded as negative, "
        "and is rejected, if its force is larger than this.",
    )  # fmt: skip
    p_delta: float = _entry(
        0.3, "fraction of the elastic stiffness", "physics",
        "Together with a yielding law, the model's spring is rejected if it is more negative than "
        "this.",
        "Eurocode 8, 4.4.2.2: the largest interstorey drift sensitivity to P-delta",
    )  # fmt: skip
    gap_in_spring: float = _entry(
        0.5, "fraction of the stated stiffness", "physics",
        "Minimum fraction of a model's spring that is inactive within a gap; less is a stop in "
        "parallel with a softer spring.",
        "halfway between a spring that is present and one that is not",
    )  # fmt: skip
    spring_gone: float = _entry(
        0.9, "fraction of the stated stiffness", "judgement",
        "Loss of stiffness beyond which no effect is expressed as a part of the remaining spring.",
    )  # fmt: skip
    seen_wear: float = _entry(
        0.1, "fraction", "judgement",
        "Minimum share of slip, and of loss, for which a column is said to pinch and degrade.",
    )  # fmt: skip

    # ---- parameters, intervals, predictions -----------------------------------------------------
    interval_simulated: float = _entry(
        5e-4, "fraction of the value", "numerics",
        "Minimum half-width of a confidence interval.",
        "the difference between two accurate simulators",
    )  # fmt: skip
    interval_estimated: float = _entry(
        2e-3, "fraction of the value", "numerics",
        "The same if the motion is estimated from noisy sensors.",
    )  # fmt: skip
    interval_of_form: float = _entry(
        0.015, "fraction of the value", "judgement",
        "The same for a specimen's law with a shape, because the true law may have another form.",
    )  # fmt: skip
    form_error: float = _entry(
        0.15, "fraction of its force", "judgement",
        "Maximum deviation of the true law from the assumed one, as a smooth function of the "
        "motion, that the confidence intervals allow for.",
    )  # fmt: skip
    prediction_follows: float = _entry(
        2.0, "multiple of its noise", "judgement",
        "A prediction may use a simulated motion whose misfit is below this.",
    )  # fmt: skip
    refined_better: float = _entry(
        0.98, "fraction of the misfit", "judgement",
        "Maximum misfit that a refinement by the simulated displacement may leave to be accepted.",
    )  # fmt: skip
    alpha_error: float = _entry(
        0.3, "samples", "judgement",
        "Maximum standard error of a recovered alpha that is reported.",
    )  # fmt: skip
    stiffness_error: float = _entry(
        0.1, "fraction of the specimen's stiffness", "judgement",
        "The same for k_t.",
    )  # fmt: skip
    recovered_unclosed: float = _entry(
        0.05, "fraction of a signal", "judgement",
        "Residual of an equation of the loop above which the test is assumed not to have used this "
        "equation.",
    )  # fmt: skip

    # ---- location of an effect, and how it is reported ------------------------------------------
    located_bend: float = _entry(
        2.0, "standard deviations", "judgement",
        "Maximum adjustment of a stated value when an unknown effect is located.",
    )  # fmt: skip
    located_white: float = _entry(
        5.0, "factor", "judgement",
        "Ratio of the residual to its whitened form above which it is whitened before an unknown "
        "effect is located.",
    )  # fmt: skip
    located_mean_s: float = _entry(
        0.02, "s", "judgement",
        "Averaging time of the noise when an unknown effect is located; shorter than a stop or a "
        "slip, at any sample rate.",
    )  # fmt: skip
    located_noise: float = _entry(
        3.5, "standard deviations", "judgement",
        "Deviation from the averaged noise that is significant.",
        "by chance, one in two thousand",
    )  # fmt: skip
    active_part: float = _entry(
        0.25, "fraction of the largest", "judgement",
        "Running rms of an effect above which it is active, which defines a time window.",
    )  # fmt: skip
    active_break_s: float = _entry(
        0.3, "s", "judgement",
        "Maximum gap between two windows that are merged.",
    )  # fmt: skip
    active_rows: float = _entry(
        0.05, "fraction of the largest", "judgement",
        "Force above which a row is used to determine where on the stroke, and on which side, an "
        "effect acts.",
    )  # fmt: skip
    local_reported: float = _entry(
        0.3, "fraction of the stroke", "judgement",
        "An effect that acts only beyond this displacement is reported as local.",
    )  # fmt: skip
    always_reported: float = _entry(
        0.9, "fraction of the recording", "judgement",
        'Minimum total length of the windows for an effect to be reported to act "throughout".',
    )  # fmt: skip
    one_sided_reported: float = _entry(
        0.95, "fraction of the rows", "judgement",
        "Minimum fraction of rows with one sign for an effect to be reported to raise or reduce "
        "the force.",
    )  # fmt: skip
    loop_met: float = _entry(
        0.05, "NRMSE", "judgement",
        "Error of a repeated simulation of the loop up to which the result is considered to "
        "reproduce the test.",
    )  # fmt: skip
    loop_hardly: float = _entry(
        0.7, "fraction of the error before", "judgement",
        "The same, relative to the error without the effects.",
    )  # fmt: skip

    # ---- rejected data --------------------------------------------------------------------------
    least_rows: int = _entry(
        100, "rows", "judgement",
        "Minimum number of rows of a recording, and of the actuator's channels.",
    )  # fmt: skip
    least_rows_static: int = _entry(
        60, "rows", "judgement",
        "Minimum number of rows of a quasi-static test, of which each is a reading of its own.",
    )  # fmt: skip
    least_rows_force: int = _entry(
        50, "rows", "judgement",
        "The same for the force.",
    )  # fmt: skip
    model_k_tol: float = _entry(
        0.02, "fraction", "judgement",
        "Standard deviation assumed for the stiffness of a model made from a rig file, which "
        "states none.",
    )  # fmt: skip
    model_c_tol: float = _entry(
        0.2, "fraction", "judgement",
        "The same for its damping.",
    )  # fmt: skip
    rate_off: float = _entry(
        0.02, "fraction", "judgement",
        "Maximum difference between the spacing of the rows and `fs_hz`.",
    )  # fmt: skip
    uneven_rows: float = _entry(
        5.0, "rows", "judgement",
        "Maximum distance of a row from its place on an even time grid.",
    )  # fmt: skip
    jitter_reported: float = _entry(
        0.5, "rows", "physics",
        "Distance above which this is reported.",
        "the row is then nearer to the place of its neighbour",
    )  # fmt: skip
    row_missing: float = _entry(
        1.5, "rows", "physics",
        "Distance between two rows above which one is missing.",
        "halfway between one and two",
    )  # fmt: skip
    time_even: float = _entry(
        0.1, "fraction", "judgement",
        "Maximum deviation of the increments of a column from their median for it to be recognised "
        "as time.",
    )  # fmt: skip
    time_rows: float = _entry(
        0.9, "fraction of the rows", "judgement",
        "Fraction of the increments that must meet this.",
    )  # fmt: skip
    numbers_least: float = _entry(
        0.5, "fraction of the rows", "judgement",
        "Minimum fraction of rows in which a channel must have a number.",
    )  # fmt: skip
    clipped_rows: float = _entry(
        0.2, "fraction of the rows", "judgement",
        "A channel is rejected if more than this fraction of its rows is at the end of the "
        "sensor's range.",
    )  # fmt: skip
    stop_beyond: float = _entry(
        0.5, "standard deviations", "judgement",
        "Minimum distance from the median at which a channel's largest reading may be a saturation "
        "level.",
    )  # fmt: skip
    stop_rows: int = _entry(
        6, "rows", "judgement",
        "Minimum number of consecutive rows at such a reading for it to be regarded as a "
        "saturation level.",
    )  # fmt: skip
    stop_readings: int = _entry(
        5, "readings", "judgement",
        "Number of distinct readings up to which saturation is not told from steps.",
    )  # fmt: skip
    stop_longer: float = _entry(
        4.0, "factor", "judgement",
        "Ratio of that duration to the longest duration at any other reading.",
    )  # fmt: skip
    stray_reading: float = _entry(
        10.0, "multiple of the channel's range", "judgement",
        "Distance beyond the range of a channel at which a reading is impossible.",
    )  # fmt: skip
    stray_jump: float = _entry(
        8.0, "standard deviations", "physics",
        "Fourth difference of a residual from which a single row may be a stray reading.",
        "noise reaches 8 in one row of 10^15; a row that is off by 11 times the noise does",
    )  # fmt: skip
    stray_healed: float = _entry(
        4.0, "standard deviations", "physics",
        "Largest fourth difference beside a stray reading, without it.",
        "noise reaches 4 in one row of 16 000",
    )  # fmt: skip
    stray_most: int = _entry(
        5, "readings", "judgement",
        "Largest number of stray readings of a channel that are excluded; more are a signal.",
    )  # fmt: skip
    stray_place: float = _entry(
        0.02, "fraction of the range of motion", "judgement",
        "Distance from either end of the motion, and from one another, within which readings may "
        "be those of a law, not stray ones.",
    )  # fmt: skip
    dead_cell: float = _entry(
        0.9, "fraction of the channel's power", "judgement",
        "Fraction of white noise in a load cell's signal from which it is regarded as noise only.",
    )  # fmt: skip
    dead_cell_follows: float = _entry(
        0.02, "fraction of its power", "judgement",
        "The signal is regarded as no measurement of the force if less than this fraction of its "
        "power is correlated with the model's force.",
    )  # fmt: skip
    short_gap: int = _entry(
        3, "rows", "judgement",
        "Maximum number of consecutive missing rows that are interpolated by a cubic.",
    )  # fmt: skip
    wrong_unit: float = _entry(
        100.0, "factor", "physics",
        "Ratio (or its inverse) beyond which a channel with the expected shape has a wrong unit.",
        "a specimen may be 30 times softer than its model; a unit that is wrong by 1000 still "
        "gives 100 if the model is wrong by ten in the other direction",
    )  # fmt: skip
    noise_of_sensor: float = _entry(
        0.03, "fraction of the signal", "physics",
        "Fourth differences above which a channel's noise is taken from the quietest part of its "
        "band.",
        "the fourth differences of motion at nine rows per cycle",
    )  # fmt: skip
    shape_alike: float = _entry(
        0.5, "correlation", "judgement",
        "Minimum correlation for a channel to be considered to have roughly the expected shape.",
    )  # fmt: skip
    shape_clearly: float = _entry(
        0.9, "correlation", "judgement",
        "Minimum correlation for a channel to be considered to have the expected shape and no "
        "other.",
    )  # fmt: skip
    shape_simulated: float = _entry(
        0.95, "correlation", "judgement",
        "Minimum correlation for a channel to be considered to have the shape of a simulated one.",
    )  # fmt: skip
    shape_balanced: float = _entry(
        0.8, "correlation", "judgement",
        "The same for a force balance, because compensators and models are not exact.",
    )  # fmt: skip
    balance_cell: float = _entry(
        0.05, "fraction of its terms", "judgement",
        "Smallest remainder of a force balance with a load cell from which a magnitude can be "
        "determined.",
    )  # fmt: skip
    balance_model: float = _entry(
        0.3, "fraction of its terms", "judgement",
        "The same for a balance with the model's forces, which cancel at resonance.",
    )  # fmt: skip
    energy_gained: float = _entry(
        0.5, "fraction of the largest", "judgement",
        "Minimum energy that a body must gain for comparison with the work of the applied force.",
    )  # fmt: skip
    spring_rules: float = _entry(
        0.3, "fraction of the stiffness", "judgement",
        "Ratio of inertia force to spring force up to which the force is considered proportional "
        "to displacement.",
    )  # fmt: skip
    against_motion: float = _entry(
        0.1, "correlation", "physics",
        "Correlation of a force with velocity, below minus which a force that opposes the "
        "displacement as well has the wrong sign.",
        "no passive specimen has a negative one; the drift of a load cell and noise may",
    )  # fmt: skip
    energy_taken: float = _entry(
        0.5, "fraction of the gain", "judgement",
        "Energy that a force must take from a body that gains energy, for its sign to be wrong.",
    )  # fmt: skip
    channels_apart_s: float = _entry(
        0.005, "s", "physics",
        "Time between two channels that is allowed for before a sign is regarded as wrong.",
        "filters and converters of one recorder; five samples at 1 kHz",
    )  # fmt: skip
    motion_lines: float = _entry(
        30.0, "multiple of the median", "judgement",
        "Amplitude above which a line is motion, in spectra whose magnitudes are compared.",
    )  # fmt: skip
    motion_lines_least: float = _entry(
        0.001, "fraction of the largest", "judgement",
        "The same relative to the largest line, because derivatives amplify the remaining noise.",
    )  # fmt: skip
    fy_explains: float = _entry(
        0.2, "fraction of the misfit", "judgement",
        "Fraction of f_meas that a force in the other direction must explain for this to be "
        "reported with its magnitude.",
    )  # fmt: skip
    fy_larger: float = _entry(
        10.0, "multiple of f_meas", "judgement",
        "Magnitude of such a force above which its noise is examined.",
    )  # fmt: skip
    unit_near: float = _entry(
        0.12, "fraction", "judgement",
        "Maximum deviation of a ratio from a conversion factor between units.",
    )  # fmt: skip
    unit_near_1000: float = _entry(
        3.0, "factor", "judgement",
        "Maximum deviation of a ratio from a power of 1000 for a channel of similar shape.",
    )  # fmt: skip
    unit_guessed: float = _entry(
        4.0, "factor", "judgement",
        "Maximum deviation of a column from the usual magnitude in a unit for that unit to be "
        "suggested.",
    )  # fmt: skip
    unit_sure: float = _entry(
        1.33, "factor", "physics",
        "Maximum deviation from that magnitude for a column whose unit is not stated.",
        "units differ by more than a factor of two",
    )  # fmt: skip
    other_test: float = _entry(
        300.0, "factor", "judgement",
        "If the magnitudes of a channel in two tests on the same rig differ by this factor or "
        "more, the second is rejected: its unit is probably wrong.",
    )  # fmt: skip


def of_size(values: Sequence[float], size: int) -> float:
    """Return the value for a set with the given number of effects."""
    return values[min(size, len(values)) - 1]


def entries() -> dict[str, ThresholdEntry]:
    """Return the description of each threshold by name, in the order of the table."""
    return {f.name: f.metadata["entry"] for f in fields(Policy)}


POLICY = Policy()
