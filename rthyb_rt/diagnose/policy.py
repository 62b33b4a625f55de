"""The thresholds that decide what a diagnosis says, in one frozen table.

Each has its unit, where it comes from, what it decides, and on what it was set. `validate-policy`
moves each of them and counts the answers that change: docs/diagnosis-policy.md. Steps, grids and
sizes of a search, which decide how long it takes and how finely it looks, stand where they are
used, and what makes a law with the law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

Origin = Literal["physics", "numerics", "calibrated", "judgement"]

BY_HAND = "set by hand"
"""What is said of the basis of a value of which nobody has written down how it was found."""


@dataclass(frozen=True)
class Entry:
    """What is known of one threshold.

    Attributes:
        unit: of its value; "part" and "times" have none.
        origin: "physics" follows from sensors, the interchange format or the statistics of noise,
            "numerics" from how well motions and forces are computed, "calibrated" was
            found on recordings that are named, "judgement" is what its authors thought fit.
        meaning: what it decides.
        basis: what the value rests on.
    """

    unit: str
    origin: Origin
    meaning: str
    basis: str


def _entry(
    value: Any, unit: str, origin: Origin, meaning: str, basis: str = BY_HAND
) -> Any:  # the type of the field it stands for
    return field(default=value, metadata={"entry": Entry(unit, origin, meaning, basis)})


@dataclass(frozen=True)
class Policy:
    """The table; `entries` gives what is known of each field.

    Of three values the first is that of a set of one effect, the last of three or more; see
    `of_size`.
    """

    # ---- what a set of effects has to bring ---------------------------------------------------
    effect_price: float = _entry(
        12.0, "chi-squared", "judgement",
        "Price of an effect beside that of its parameters: it was picked among many.",
    )  # fmt: skip
    stated_number_price: float = _entry(
        13.0, "chi-squared", "judgement",
        "Whole price of an effect that only moves a stated number: it has nothing to choose.",
    )  # fmt: skip
    several_price: float = _entry(
        1.25, "times", "judgement", "Times its price that a set of several effects has to earn.",
    )  # fmt: skip
    held_out_share: float = _entry(
        0.3, "part", "judgement",
        "Part of its gain that a set has to keep on rows that it was not fitted to.",
    )  # fmt: skip
    least_force: float = _entry(
        1e-3, "part of the force", "judgement",
        "Least size of an effect, on the force or on the displacement: less is not a finding.",
    )  # fmt: skip
    needed_share: tuple[float, float, float] = _entry(
        (0.0, 4e-3, 2.5e-2), "part of what is explained", "judgement",
        "Least part of what a set of one, two or three explains that each of its effects has to "
        "explain alone: less may be the form of the other one's law.",
    )  # fmt: skip
    needed_share_actuator: float = _entry(
        1.5e-3, "part of what is explained", "judgement",
        "The same of effects of the actuator, beside one another.",
    )  # fmt: skip
    estimated_motion: float = _entry(
        2.5, "times", "judgement",
        "Times that the shares above and the misfits below may be where the motion is estimated: "
        "it is blurred.",
    )  # fmt: skip
    promising_price: float = _entry(
        0.3, "times its price", "numerics",
        "What a set has to bring, in the shapes that are tried first, to be refined at all.",
    )  # fmt: skip
    promising_price_beside: float = _entry(
        0.5, "times its price", "numerics",
        "The same of an effect beside a set that is refined already.",
    )  # fmt: skip
    promising_pair: float = _entry(
        4.0, "chi-squared", "numerics",
        "By what a pair, in the shapes that are tried first, has to be better than the best "
        "single effect.",
    )  # fmt: skip
    search_ends: float = _entry(
        1.03, "chi-squared a row", "numerics",
        "What the best set leaves from which on triples, and other laws of friction, are tried.",
    )  # fmt: skip

    changed_numbers: float = _entry(
        3.5, "standard deviations", "physics",
        "How far beyond chance the numbers of a set may be others in a part of the recording.",
        "one in four thousand by chance, of five parts one in nine hundred",
    )  # fmt: skip
    changed_within: float = _entry(
        0.05, "part of a number", "judgement",
        "Standard deviation by which a law's numbers may be others in a part of the recording: "
        "specimens warm and wear.",
        "two of them are the 10 per cent within which the proof counts a number as right",
    )  # fmt: skip

    # ---- which of several sets is named --------------------------------------------------------
    same_evidence: float = _entry(
        9.0, "chi-squared", "physics",
        "Sets that differ by less cannot be told apart.",
        "three standard deviations of one parameter",
    )  # fmt: skip
    twin_evidence: float = _entry(
        2.0, "chi-squared", "judgement",
        "Difference up to which a recording shows none at all between two effects.",
    )  # fmt: skip
    dearer_rival: float = _entry(
        1.5, "times same_evidence", "judgement",
        "Price of one more parameter in a rival: a law that goes over into a simpler one fits as "
        "well by its nature, and is a rival only where its parameter brings something.",
    )  # fmt: skip
    dearer_rival_actuator: float = _entry(
        1.1, "times same_evidence", "judgement", "The same of effects of the actuator.",
    )  # fmt: skip
    richer_friction_share: float = _entry(
        1e-3, "part of what is explained", "judgement",
        "Least part of what dry friction explains that a Stribeck peak or bristles have to add.",
    )  # fmt: skip
    richer_friction_gain: float = _entry(
        12.0, "chi-squared", "judgement",
        "What they have to add at least beyond their price, however little is explained.",
    )  # fmt: skip
    yielding_gain: float = _entry(
        25.0, "chi-squared", "judgement",
        "What bristles beside another stiffness have to bring beyond yielding, which is the same.",
    )  # fmt: skip
    bristles_as_lost: float = _entry(
        0.1, "part of the bristles' stiffness", "judgement",
        "How near that stiffness and what the spring beside it lost have to be to be one slider.",
    )  # fmt: skip
    bristles_as_lost_tolerance: float = _entry(
        3.0, "standard deviations of the stated stiffness", "physics",
        "How much farther apart they may be for the model's own tolerance.",
        "three standard deviations",
    )  # fmt: skip
    quick_relaxation: float = _entry(
        0.1, "rad", "judgement",
        "Relaxation time times the motion's frequency up to which relaxation is a dashpot.",
    )  # fmt: skip
    form_alone: float = _entry(
        1.5e-3, "part of what is explained", "judgement",
        "By how much two sets may differ for the form of a law alone.",
    )  # fmt: skip
    other_form: float = _entry(
        0.03, "part of what is explained", "judgement",
        "By how much another form of a law may do worse and still widen its intervals.",
    )  # fmt: skip
    noise_reached: float = _entry(
        0.2, "part of the misfit", "judgement",
        "What a set may leave beyond noise, of what another leaves, to be one that ends at it.",
    )  # fmt: skip
    form_seen: float = _entry(
        0.03, "misfit in noise power", "judgement",
        "Misfit beyond noise, of a load cell's force, that may be the form of a law.",
    )  # fmt: skip
    form_moved: float = _entry(
        1.0, "misfit in noise power", "judgement", "The same of a motion that is simulated.",
    )  # fmt: skip
    form_of_rig: float = _entry(
        0.1, "misfit in noise power", "judgement",
        "The same of a rig that is simulated whole: nothing magnifies there what a form leaves.",
    )  # fmt: skip
    refused_excess: float = _entry(
        0.3, "misfit in noise power", "judgement",
        "Misfit beyond noise from which an effect that was refused is looked at again.",
    )  # fmt: skip
    refused_price: float = _entry(
        5.0, "times its price", "judgement", "What such an effect has to earn.",
    )  # fmt: skip
    drift_in_halves: float = _entry(
        0.5, "part of its rate", "judgement",
        "Rate that a drift beside a naive model has to have within each half of the recording.",
    )  # fmt: skip
    drift_unsure: float = _entry(
        0.5, "part of its rate", "judgement",
        "Standard deviation of that rate from which the halves say nothing.",
    )  # fmt: skip
    pair_beyond_chance: float = _entry(
        1.5, "standard deviations of chi-squared", "judgement",
        "Misfit of the displacement from which a pair of the actuator's effects is looked for.",
        "one in fifteen by chance",
    )  # fmt: skip
    pair_excess: float = _entry(
        0.05, "misfit in noise power", "numerics",
        "The same where the model states no tolerance, and of triples.",
    )  # fmt: skip
    pair_share: float = _entry(
        2e-3, "part of the misfit", "numerics", "What a single effect may leave more, beside that.",
    )  # fmt: skip
    actuator_at_noise: float = _entry(
        0.05, "misfit in noise power", "judgement",
        "Misfit of the displacement that the estimate of its noise may be wrong by.",
    )  # fmt: skip
    actuator_at_noise_price: float = _entry(
        2.0, "times its price", "judgement",
        "What an effect of the actuator has to earn to be excused from its share there.",
    )  # fmt: skip

    # ---- what a set may leave ------------------------------------------------------------------
    left_stated: tuple[float, float, float] = _entry(
        (0.05, 0.015, 0.008), "part of the misfit", "judgement",
        "What a set of one, two, three effects may leave beside noise where the lab states how "
        "well it knows its model: laws differ in form, but several fit almost anything.",
    )  # fmt: skip
    left_moved: tuple[float, float, float] = _entry(
        (0.02, 0.01, 0.005), "part of the misfit", "judgement",
        "The same of a simulated motion, near resonance a magnified picture of the force.",
    )  # fmt: skip
    left_naive: float = _entry(
        0.35, "part of the misfit", "judgement",
        "The same for a model without stated tolerances: real specimens are no clean laws.",
    )  # fmt: skip
    excess_as_noise: float = _entry(
        0.1, "misfit in noise power", "judgement",
        "Misfit beyond noise that is never held against a set.",
    )  # fmt: skip
    excess_of_nothing: float = _entry(
        0.15, "misfit in noise power", "judgement",
        "What the model alone may leave of the force more than that.",
    )  # fmt: skip
    excess_of_nothing_actuator: float = _entry(
        0.3, "misfit in noise power", "judgement", "The same of the displacement.",
    )  # fmt: skip
    colourless: float = _entry(
        1.5, "times", "judgement",
        "Factor by which evidence was scaled down below which a residual has no colour.",
    )  # fmt: skip
    colourless_excess: float = _entry(
        0.5, "misfit in noise power", "judgement",
        "Misfit up to which such a residual is a data sheet that states too little.",
    )  # fmt: skip
    coloured_evidence: float = _entry(
        1.3, "times", "judgement",
        "How much rows have to hang together for the search to be done again with less evidence.",
    )  # fmt: skip
    coloured_cell: float = _entry(
        1.3, "times", "judgement",
        "The same from which a load cell on moving ground is not believed alone.",
    )  # fmt: skip
    white_residual: float = _entry(
        1.1, "times", "judgement",
        "Inflation (`select.inflation`) up to which a residual is mere noise, and nothing that "
        "begins in mid-record is looked for.",
    )  # fmt: skip
    motion_understood: float = _entry(
        1.5, "chi-squared a row", "judgement",
        "What the actuator's best set may leave for its simulated motion to be the true one.",
    )  # fmt: skip
    blur_free: float = _entry(
        0.008, "part of the force", "judgement",
        "What the estimate of a free body's motion may leave unexplained.",
    )  # fmt: skip
    blur_cell: float = _entry(
        0.002, "part of the force", "judgement", "The same where a load cell tells the force.",
    )  # fmt: skip
    within_tolerance: float = _entry(
        3.6, "standard deviations", "judgement",
        "How far a stated number may be moved for the model to be right as it is.",
    )  # fmt: skip
    bent_number: float = _entry(
        4.0, "standard deviations", "judgement",
        "How far a stated number, or the mass that an estimated motion blurs, is bent when its "
        "effect stands in for it.",
    )  # fmt: skip
    strained_offset: float = _entry(
        6.0, "standard deviations", "judgement", "Time offset that is no nuisance any more.",
    )  # fmt: skip

    # ---- what is simulated ----------------------------------------------------------------------
    moved_decisive: float = _entry(
        0.005, "part of the misfit", "judgement",
        "What a set may leave of the motion's to be believed against the balance of forces.",
    )  # fmt: skip
    moved_excess: float = _entry(
        0.2, "misfit in noise power", "judgement",
        "Misfit of a motion up to which the same holds.",
    )  # fmt: skip
    motion_met: float = _entry(
        1.5, "mean square in noise power", "judgement",
        "Up to which a simulated displacement is the measured one.",
    )  # fmt: skip
    motion_met_alone: float = _entry(
        1.05, "mean square in noise power", "physics",
        "The same of a fit that is not to be bettered.", "noise is not known any better",
    )  # fmt: skip
    motion_close: float = _entry(
        0.005, "part of the model's misfit", "numerics",
        "The same: simulators of friction differ by so much.",
    )  # fmt: skip
    simulators_differ: float = _entry(
        1.5e-4, "part of the displacement", "numerics", "What two good simulators differ by.",
    )  # fmt: skip
    nuisance_reach: float = _entry(
        3.0, "standard deviations", "physics",
        "How far mass, offset in time and zero of the force move at most in a simulation.",
        "three standard deviations",
    )  # fmt: skip
    rig_follows: float = _entry(
        1.5, "mean square in noise power", "judgement",
        "Up to which the motion that a whole rig simulates is the true one.",
    )  # fmt: skip
    rig_nothing_left: float = _entry(
        1.01, "chi-squared a row", "judgement",
        "What a simulated rig leaves from which on no further effect is looked for: less than "
        "noise is known by, 3 per cent in 20 s, so that a small one beside a large one is found.",
    )  # fmt: skip
    motion_rough: float = _entry(
        3.0, "chi-squared a row", "numerics",
        "What it leaves from which a fit need not be a good one of its kind.",
    )  # fmt: skip
    simulated_nrmse: float = _entry(
        0.012, "NRMSE", "judgement",
        "Error of a free body's simulated displacement below which nothing is missing.",
    )  # fmt: skip
    simulated_unseen: float = _entry(
        0.004, "NRMSE", "judgement",
        "The same beyond the noise of the displacement: more is a motion that the model does not "
        "make.",
    )  # fmt: skip
    felt_by_cell: float = _entry(
        0.05, "part of the misfit", "judgement",
        "What a simulated motion may leave of a load cell's readings in most rows.",
    )  # fmt: skip

    # ---- nuisance and noise ---------------------------------------------------------------------
    offset_prior_s: float = _entry(
        5e-5, "s", "physics", "Standard deviation of the time offset between channels.",
        "the interchange format: 0.1 ms is normal and no finding",
    )  # fmt: skip
    offset_reach_s: float = _entry(
        1.5e-4, "s", "judgement",
        "Offset of the displacement that is still nuisance: against a large effect its prior alone "
        "would give way.",
    )  # fmt: skip
    mass_blur: float = _entry(
        0.005, "part of the mass", "judgement",
        "Standard deviation that the estimate of a motion puts on the mass.",
    )  # fmt: skip
    noise_held: float = _entry(
        1.3, "times", "physics",
        "How far the measured white noise of a channel may be off its data sheet's.",
        "sheets are right within 20 per cent (interchange format); the margin is judgement",
    )  # fmt: skip
    sheet_factor: float = _entry(
        1.25, "times", "physics", "Times its data sheet that noise may be, or its inverse.",
        "sheets are right within 20 per cent (interchange format): 1 / 0.8",
    )  # fmt: skip
    power_scatter: float = _entry(
        3.0, "standard deviations", "physics",
        "By how much the power of what is left may exceed that of its noise over so few rows.",
        "three standard deviations of chi-squared",
    )  # fmt: skip
    noise_burst: float = _entry(
        1.35, "times", "judgement",
        "Times its rms over all that noise may have over a second of it: more is an event.",
    )  # fmt: skip
    noise_beside_motion: float = _entry(
        0.01, "part of the motion's power", "judgement",
        "What of it, by velocity, may lie outside its band, half at either end.",
    )  # fmt: skip
    noise_room: float = _entry(
        0.25, "sampling rates", "judgement",
        "Top of the motion's band from which too little of the band is left to tell the noise.",
    )  # fmt: skip
    noise_steepest: float = _entry(
        2.0, "power of 1 / f", "physics",
        "Steepest that noise rises towards slow motion.", "a random walk",
    )  # fmt: skip
    noise_near: float = _entry(
        4.0, "times", "judgement",
        "Times the top of the motion's band up to which noise tells of the noise within.",
    )  # fmt: skip
    noise_line: float = _entry(
        6.0, "times", "physics", "Times its level that the power of a line of noise has.",
        "one in 400 has more",
    )  # fmt: skip
    noise_spectra: int = _entry(
        6, "parts", "numerics",
        "Parts of a recording, at least, whose spectra tell a sensor's noise from what the "
        "others show too.",
        "overlapping by half they are eleven: one other channel takes a tenth of a line by "
        "chance",
    )  # fmt: skip
    noise_part_s: float = _entry(
        2.0, "s", "numerics", "Longest of those parts.", "lines half a hertz apart",
    )  # fmt: skip
    noise_independent: float = _entry(
        0.9, "spectra", "judgement", "Independent spectra that each of those parts brings.",
        "0.997 of white noise by the formula of parts that overlap by half under this window "
        "(Welch 1967); less where noise has a colour",
    )  # fmt: skip
    noise_shared: float = _entry(
        0.2, "part of a line's power", "judgement",
        "What the others may show of a line that counts as noise.",
        "it adds a quarter to the noise",
    )  # fmt: skip
    noise_moves: float = _entry(
        0.5, "part of a line's power", "physics",
        "What they show of a line from which it is motion more than noise.",
    )  # fmt: skip
    noise_neighbours: int = _entry(
        3, "lines", "numerics", "Lines to either side that this is averaged with.",
        "one alone may be shared by chance",
    )  # fmt: skip
    noise_rows: float = _entry(
        0.5, "part of the rows", "judgement",
        "Rows that have to count for the colour of noise to be told from them.",
    )  # fmt: skip
    hangs_together: float = _entry(
        0.05, "correlation", "numerics",
        "Correlation of a residual from which on later rows are taken not to hang together with "
        "it.",
    )  # fmt: skip
    force_accuracy: float = _entry(
        0.004, "part of the force", "judgement", "What a body's free motion tells of it at best.",
    )  # fmt: skip
    abrupt_model: float = _entry(
        0.3, "standard deviations of noise", "physics",
        "By what a normal offset in time may depart from a straight line over the force's rate in "
        "a row that is judged.",
        "it adds less than a tenth to the noise's power",
    )  # fmt: skip
    abrupt_rows: float = _entry(
        0.9, "part of the rows", "judgement",
        "Rows that have to be left for those in which it departs by more to be left out: a motion "
        "that is abrupt throughout is judged as it is.",
    )  # fmt: skip
    hum_line: float = _entry(
        6.0, "times", "judgement",
        "Times the spectrum about it that a line has to stand out to be tried as hum.",
    )  # fmt: skip
    faint_force: float = _entry(
        0.1, "part of the noise", "judgement",
        "Size of a force, hertz by hertz, below which it tells nothing of its time.",
    )  # fmt: skip
    abrupt_force: float = _entry(
        3.0, "times", "judgement",
        "Times as much of it above that frequency as of the model's force, from which it jumps.",
    )  # fmt: skip

    # ---- steps of a coarse load cell ------------------------------------------------------------
    coarse_readings: float = _entry(
        0.5, "part of the rows", "judgement",
        "Distinct readings from which a load cell is no coarse one.",
    )  # fmt: skip
    coarse_on_grid: float = _entry(
        0.98, "part of the readings", "judgement", "How many have to lie on one grid.",
    )  # fmt: skip
    coarse_near: float = _entry(
        0.15, "parts of a turn of 2 pi", "judgement",
        "How far off its grid a reading may lie, and be on it.",
    )  # fmt: skip
    rounded_rows: float = _entry(
        0.02, "part of the rows", "judgement",
        "Rows beyond half a step and the noise where the model alone is right.",
    )  # fmt: skip
    rounded_noise: float = _entry(
        3.0, "standard deviations of noise", "physics",
        "What a row may lie beyond half a step for noise.", "three standard deviations",
    )  # fmt: skip
    rounded_outside: float = _entry(
        0.002, "part of the rows", "judgement",
        "Rows that may lie farther off than rounding explains, whatever is named.",
    )  # fmt: skip
    rounded_as_best: float = _entry(
        5.0, "times the best set's", "judgement",
        "Rows beyond rounding that the model alone may have more than the best set.",
    )  # fmt: skip
    rounded_gain: float = _entry(
        400.0, "chi-squared", "judgement",
        "What a set brings beyond its price from which rounding is not all of it.",
    )  # fmt: skip
    rounded_excess: float = _entry(
        0.25, "misfit in noise power", "judgement", "What it may leave then.",
    )  # fmt: skip
    rounded_better: float = _entry(
        0.2, "times the best set's", "judgement",
        "Rows beyond rounding of a set that goes before the best one by chi-squared.",
    )  # fmt: skip
    rounded_alike: float = _entry(
        2.0, "times the best set's", "judgement",
        "The same of a part of it, or of a rival, that rounding does not part from it.",
    )  # fmt: skip

    # ---- what begins in mid-record, and recordings that do --------------------------------------
    absent_before: float = _entry(
        0.5, "part of its later size", "physics",
        "What an effect must not have before it begins.",
        "half way between one that is not there and one that is there throughout",
    )  # fmt: skip
    absent_sure: float = _entry(
        2.0, "standard deviations", "physics", "By how much it has to be known that it has not.",
        "two standard deviations",
    )  # fmt: skip
    start_at_rest: float = _entry(
        0.02, "part of the largest displacement", "judgement",
        "What a body at rest moves at most in a tenth of a second.",
    )  # fmt: skip
    motion_from_hz: float = _entry(
        0.3, "Hz", "numerics",
        "Frequency below which displacement is not held against accelerations.",
        "a window over the recording and a wandering zero stand in for motion there",
    )  # fmt: skip
    accelerometer_from_hz: float = _entry(
        0.2, "Hz", "numerics", "Frequency above which an accelerometer tells of the displacement.",
    )  # fmt: skip
    motion_clear: float = _entry(
        3.5, "times the noise's power", "judgement",
        "From which on a line of a smoothed spectrum is motion.",
    )  # fmt: skip
    static_hz: float = _entry(
        50.0, "Hz", "judgement",
        "Rows a second up to which a model without rates may belong to a quasi-static test.",
    )  # fmt: skip
    static_rate_noise: float = _entry(
        0.02, "part of the median rate", "judgement",
        "Noise of such a test's rate from which rows around turns are not judged.",
    )  # fmt: skip
    static_straight: float = _entry(
        0.3, "part of the rows", "judgement",
        "Straight strokes from which such a test is one of ramps.",
    )  # fmt: skip
    static_rows: float = _entry(
        0.5, "part of the rows", "judgement",
        "Rows that have to be left for those around turns to be left out.",
    )  # fmt: skip
    static_apart: float = _entry(
        4.0, "standard deviations", "physics",
        "By which two displacements differ that are not one.",
        "six in a hundred thousand by chance",
    )  # fmt: skip
    stroke_straight: float = _entry(
        1.25, "times its noise", "judgement", "What a straight stroke may be off its line, rms.",
    )  # fmt: skip
    stroke_bent: float = _entry(
        4.0, "standard deviations", "physics", "How far the mean of a third of it may be off.",
        "six in a hundred thousand by chance",
    )  # fmt: skip
    stroke_rests: float = _entry(
        5.0, "standard deviations", "physics", "Slope of a stroke below which it rests.",
        "one in two million by chance",
    )  # fmt: skip
    command_at_rest: float = _entry(
        1e-3, "part of the largest command", "judgement",
        "A command no larger than this may belong to an actuator at rest.",
    )  # fmt: skip
    moving_at_start: float = _entry(
        0.02, "part of the largest velocity", "judgement",
        "An actuator that is faster in the first hundredth of a second, beyond what noise shows, "
        "was on its way before.",
    )  # fmt: skip
    forgotten_force: float = _entry(
        0.3, "standard deviations of noise", "judgement",
        "By which two forces differ that count as one: a yielding model has forgotten its start.",
        "it adds less than a tenth to the noise's power",
    )  # fmt: skip
    forgotten_by: float = _entry(
        0.4, "part of the recording", "judgement",
        "What may be spent on forgetting the start; else all is looked at.",
    )  # fmt: skip
    past_better: float = _entry(
        0.5, "part of the misfit", "judgement",
        "What a past may leave of the first rows of a second recording: else none is taken.",
    )  # fmt: skip

    # ---- channels that say the same twice, and channels that no model knows ---------------------
    accelerometer_gain: float = _entry(
        0.02, "part", "physics",
        "Gain by which an accelerometer may differ from the displacement's second derivative.",
        "sensors are calibrated to a per cent each",
    )  # fmt: skip
    accelerometer_late_s: float = _entry(
        2e-4, "s", "physics", "Time by which it may.",
        "each channel may be off by 0.1 ms as is normal",
    )  # fmt: skip
    accelerometer_clear: float = _entry(
        10.0, "times its noise", "physics", "What a frequency has to stand out by to tell that.",
        "its bias is then one per cent at most",
    )  # fmt: skip
    accelerometer_sure: float = _entry(
        3.0, "standard deviations", "physics", "By how much it has to differ by more.",
        "three standard deviations",
    )  # fmt: skip
    modulation_channels: int = _entry(
        4, "channels", "numerics",
        "Channels that no model knows that are tried: more make chance findings, and hours.",
    )  # fmt: skip
    modulation_shifts: int = _entry(
        19, "shifts", "physics",
        "Places, forwards and backwards each, in which such a channel may not gain as much.",
        "a permutation test: by chance in 1 of 39",
    )  # fmt: skip
    modulation_share: float = _entry(
        4e-3, "part of what is explained", "judgement",
        "What a modulation adds at least beside a naive model.",
        "as `needed_share` of two effects",
    )  # fmt: skip
    modulation_own: float = _entry(
        0.5, "part of its coefficient", "judgement",
        "What the rest of a channel has to have beside what follows from the motion.",
    )  # fmt: skip
    modulation_alone: float = _entry(
        1e-6, "part of its variance", "numerics",
        "What has to be left of a channel beside the motion for anything to be told.",
    )  # fmt: skip
    modulation_turned: float = _entry(
        -0.1, "part of its mean", "judgement",
        "Least coefficient of a law within the recording, where it has a sign.",
    )  # fmt: skip

    # ---- laws -----------------------------------------------------------------------------------
    spring_level: float = _entry(
        0.01, "part of the steepest slope", "numerics",
        "Slope of a spring below which it is level, so that beside a yielding law it may be.",
    )  # fmt: skip
    gap_in_spring: float = _entry(
        0.5, "part of the stated stiffness", "physics",
        "Least part of a model's spring that does nothing within a gap; less is a stop beside a "
        "softer spring.",
        "half way between a spring that is there and one that is not",
    )  # fmt: skip
    spring_gone: float = _entry(
        0.9, "part of the stated stiffness", "judgement",
        "Loss of it beyond which nothing is told as a part of the spring there is.",
    )  # fmt: skip
    seen_wear: float = _entry(
        0.1, "part", "judgement",
        "Least share of slack, and of what is lost, for which a column pinches and degrades.",
    )  # fmt: skip

    # ---- parameters, intervals, predictions -----------------------------------------------------
    interval_simulated: float = _entry(
        5e-4, "part of the value", "numerics", "Least half-width of an interval.",
        "what two good simulators differ by",
    )  # fmt: skip
    interval_estimated: float = _entry(
        2e-3, "part of the value", "numerics",
        "The same where the motion is estimated from noisy sensors.",
    )  # fmt: skip
    interval_of_form: float = _entry(
        0.015, "part of the value", "judgement",
        "The same of a specimen's law that has a shape: the true one may have another form.",
    )  # fmt: skip
    form_error: float = _entry(
        0.15, "part of its force", "judgement",
        "Most by which a smooth function of the motion may bend a law, for its intervals.",
    )  # fmt: skip
    prediction_follows: float = _entry(
        2.0, "times its noise", "judgement",
        "How near a simulated motion has to be for a prediction to go along it.",
    )  # fmt: skip
    refined_better: float = _entry(
        0.98, "part of the misfit", "judgement",
        "What a refinement by the simulated displacement may leave to be kept.",
    )  # fmt: skip
    alpha_error: float = _entry(
        0.3, "samples", "judgement", "Largest standard error of a recovered alpha that is one.",
    )  # fmt: skip
    stiffness_error: float = _entry(
        0.1, "part of the specimen's stiffness", "judgement", "The same of k_t.",
    )  # fmt: skip
    recovered_unclosed: float = _entry(
        0.05, "part of a signal", "judgement",
        "What the loop's equation may leave, beyond which it is not the one that was solved.",
    )  # fmt: skip

    # ---- where and how it is told ---------------------------------------------------------------
    located_bend: float = _entry(
        2.0, "standard deviations", "judgement",
        "What a stated number moves at most where something unknown is located.",
    )  # fmt: skip
    located_white: float = _entry(
        5.0, "times", "judgement",
        "Times the residual where the motion is known, from which all of it is mere noise.",
    )  # fmt: skip
    located_mean_s: float = _entry(
        0.02, "s", "judgement",
        "Time over which noise is averaged where something unknown is located: shorter than a "
        "stop or a slip, at any rate of rows.",
    )  # fmt: skip
    located_noise: float = _entry(
        3.5, "standard deviations", "judgement", "What stands out of the averaged noise.",
        "one in two thousand by chance",
    )  # fmt: skip
    active_part: float = _entry(
        0.25, "part of the largest", "judgement",
        "Running rms of an effect from which it acts, and makes a window of time.",
    )  # fmt: skip
    active_break_s: float = _entry(
        0.3, "s", "judgement", "Break between two windows that is taken along.",
    )  # fmt: skip
    active_rows: float = _entry(
        0.05, "part of the largest", "judgement",
        "Force from which a row counts for where on the stroke, and to which side, it acts.",
    )  # fmt: skip
    told_local: float = _entry(
        0.3, "part of the stroke", "judgement",
        "Displacement beyond which alone an effect acts for that to be said.",
    )  # fmt: skip
    told_always: float = _entry(
        0.9, "part of the recording", "judgement", 'Windows from which it is "throughout".',
    )  # fmt: skip
    told_one_sided: float = _entry(
        0.95, "part of the rows", "judgement", "Rows of one sign from which it is more, or less.",
    )  # fmt: skip
    loop_met: float = _entry(
        0.05, "NRMSE", "judgement",
        "Error of a loop simulated again up to which what was found brings the test back.",
    )  # fmt: skip
    loop_hardly: float = _entry(
        0.7, "part of the error before", "judgement", "The same.",
    )  # fmt: skip

    # ---- what is refused ------------------------------------------------------------------------
    least_rows: int = _entry(
        100, "rows", "judgement", "Rows of a recording, and of the actuator's, to be judged.",
    )  # fmt: skip
    least_rows_force: int = _entry(
        50, "rows", "judgement", "The same of the force.",
    )  # fmt: skip
    model_k_tol: float = _entry(
        0.02, "part", "judgement",
        "Standard deviation of the stiffness in a rig file that a model is made of; it says "
        "none.",
    )  # fmt: skip
    model_c_tol: float = _entry(
        0.2, "part", "judgement", "The same of its damping.",
    )  # fmt: skip
    rate_off: float = _entry(
        0.02, "part", "judgement", "How far the rows' distance may be off `fs_hz`.",
    )  # fmt: skip
    uneven_rows: float = _entry(
        5.0, "rows", "judgement", "How far a row may lie off an even distance.",
    )  # fmt: skip
    jitter_told: float = _entry(
        0.5, "rows", "physics", "From which on that is told.",
        "a row is then nearer to its neighbour's place",
    )  # fmt: skip
    row_missing: float = _entry(
        1.5, "rows", "physics", "Distance of two rows from which one is missing between.",
        "half way between one and two",
    )  # fmt: skip
    time_even: float = _entry(
        0.1, "part", "judgement",
        "How far steps of a column may be off their median for it to count time.",
    )  # fmt: skip
    time_rows: float = _entry(
        0.9, "part of the rows", "judgement", "Steps that have to be as even.",
    )  # fmt: skip
    numbers_least: float = _entry(
        0.5, "part of the rows", "judgement", "Rows with a number that a channel needs.",
    )  # fmt: skip
    clipped_rows: float = _entry(
        0.2, "part of the rows", "judgement", "Rows at a sensor's end from which it is refused.",
    )  # fmt: skip
    stop_beyond: float = _entry(
        0.5, "standard deviations", "judgement",
        "How far from its median a channel's largest reading may be a stop.",
    )  # fmt: skip
    stop_rows: int = _entry(
        6, "rows", "judgement", "Rows in a row at such a reading from which it is one.",
    )  # fmt: skip
    stop_longer: float = _entry(
        4.0, "times", "judgement", "Times as long as the channel stays on any other reading.",
    )  # fmt: skip
    stray_reading: float = _entry(
        10.0, "ranges of the channel", "judgement",
        "How far beyond it a reading is that cannot be one.",
    )  # fmt: skip
    dead_cell: float = _entry(
        0.9, "part of the channel", "judgement",
        "White noise in a load cell from which it is taken for nothing else.",
    )  # fmt: skip
    dead_cell_follows: float = _entry(
        0.02, "part of its power", "judgement",
        "What may follow the model in it to be no measurement of it.",
    )  # fmt: skip
    short_gap: int = _entry(
        3, "rows", "judgement",
        "Rows missing in one place that a cubic through their neighbours stands for.",
    )  # fmt: skip
    wrong_unit: float = _entry(
        100.0, "times", "physics",
        "Ratio from which on (or from its inverse down) a channel that has the shape has a wrong "
        "unit.",
        "a specimen may be 30 times softer than its model; 1000 beside a model that is wrong by "
        "ten lies as far beyond",
    )  # fmt: skip
    shape_alike: float = _entry(
        0.5, "correlation", "judgement",
        "From which on a channel has the shape of what it is held against, more or less.",
    )  # fmt: skip
    shape_clearly: float = _entry(
        0.9, "correlation", "judgement", "From which on it has that shape and no other.",
    )  # fmt: skip
    shape_simulated: float = _entry(
        0.95, "correlation", "judgement",
        "From which on a channel has the shape of one that is simulated.",
    )  # fmt: skip
    shape_balanced: float = _entry(
        0.8, "correlation", "judgement",
        "The same of a balance of forces: compensators and models are not quite right.",
    )  # fmt: skip
    balance_cell: float = _entry(
        0.05, "part of its parts", "judgement",
        "What has to be left of a balance with a load cell for it to tell a size.",
    )  # fmt: skip
    balance_model: float = _entry(
        0.3, "part of its parts", "judgement",
        "The same of one with the model's forces: at resonance they cancel.",
    )  # fmt: skip
    energy_gained: float = _entry(
        0.5, "part of the largest", "judgement",
        "What a body has to gain of its energy for the push's work to be held against it.",
    )  # fmt: skip
    spring_rules: float = _entry(
        0.3, "part of the stiffness", "judgement",
        "Inertia per displacement up to which a force goes with the spring.",
    )  # fmt: skip
    motion_lines: float = _entry(
        30.0, "times the median", "judgement",
        "Amplitude of a line from which it is motion, in a spectrum that is compared in size.",
    )  # fmt: skip
    motion_lines_least: float = _entry(
        0.001, "part of the largest", "judgement",
        "The same, of the largest line: derivatives lift what noise is left.",
    )  # fmt: skip
    fy_explains: float = _entry(
        0.2, "part of the misfit", "judgement",
        "What a force in the other direction has to explain of f_meas for its size to be told "
        "so.",
    )  # fmt: skip
    fy_larger: float = _entry(
        10.0, "times f_meas", "judgement",
        "Size of such a force from which its noise is looked at.",
    )  # fmt: skip
    unit_near: float = _entry(
        0.12, "part", "judgement", "How far a ratio may miss a factor of units, and be one.",
    )  # fmt: skip
    unit_near_1000: float = _entry(
        3.0, "times", "judgement",
        "How far a ratio may miss a power of 1000 for a channel of a like shape.",
    )  # fmt: skip
    unit_guessed: float = _entry(
        4.0, "times", "judgement",
        "How far a column may miss a unit's usual size for that unit to be proposed.",
    )  # fmt: skip
    unit_sure: float = _entry(
        1.33, "times", "physics", "How far a column of unstated unit may miss its size.",
        "units differ by more than two",
    )  # fmt: skip
    other_test: float = _entry(
        300.0, "times", "judgement",
        "Ratio of one channel in two tests of a rig: between a sensor's noise and its range.",
    )  # fmt: skip


def of_size(values: Sequence[float], size: int) -> float:
    """Return the value for a set of so many effects."""
    return values[min(size, len(values)) - 1]


def entries() -> dict[str, Entry]:
    """Return what is known of each threshold, by name, in the table's order."""
    return {f.name: f.metadata["entry"] for f in fields(Policy)}


POLICY = Policy()
