"""Channels of user-defined laws and parts: no name replaces a signal of the recording."""

from __future__ import annotations

from typing import ClassVar

import own_parts
import pytest

import rthyb_rt as rt

SHORT = rt.Test("section5-T0.5", ground_motion={"duration_s": 1}, test={"free_vibration_s": 0})


class LawWithReference(own_parts.Inverse):
    values: ClassVar[dict[str, str]] = {"effort": "m", "x_ref_m": "m"}


class LawWithReading(own_parts.Inverse):
    values: ClassVar[dict[str, str]] = {"effort": "m", "x_true_m": "m"}


class LawWithVelocity(own_parts.Inverse):
    values: ClassVar[dict[str, str]] = {"velocity": "m/s"}


class PartWithTime(own_parts.Oscillator):
    responses: ClassVar[dict[str, str]] = {"t_s": "s"}


def refusal(**changes: object) -> str:
    with pytest.raises(rt.InputError) as error:
        rt.run(SHORT.with_(**changes))
    return str(error.value)


def test_a_law_that_names_a_value_like_the_reference_is_refused_with_its_class() -> None:
    said = refusal(controller=LawWithReference(0.01))
    assert "test_own_names.py:" in said
    assert 'LawWithReference.values names "x_ref_m", but exported files have a variable' in said


def test_a_law_that_names_a_value_like_a_true_reading_is_refused() -> None:
    said = refusal(controller=LawWithReading(0.01))
    assert 'LawWithReading.values names "x_true_m", but a recording of this test already' in said


def test_a_part_that_names_a_response_like_the_time_is_refused_with_its_class() -> None:
    said = refusal(numerical=PartWithTime(4000.0))
    assert "test_own_names.py:" in said
    assert 'PartWithTime.responses names "t_s", but exported files have a variable' in said


def test_law_and_part_cannot_both_report_a_name() -> None:
    said = refusal(numerical=own_parts.Oscillator(4000.0), controller=LawWithVelocity(0.01))
    assert 'LawWithVelocity.values names "velocity", but a recording of this test already' in said


def test_an_extra_sensor_cannot_have_the_name_of_a_response() -> None:
    extra = [{"name": "velocity", "unit": "m/s", "measures": "velocity"}]
    rig = SHORT.rig.with_(sensors={"extra": extra})
    said = refusal(numerical=own_parts.Oscillator(4000.0), rig=rig)
    assert 'found "velocity", but a recording of this test already has a channel' in said
