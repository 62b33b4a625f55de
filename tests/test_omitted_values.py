"""A rig file that omits values of its actuator: every command states the values that it used."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import rthyb_rt as rt
from rthyb_rt import cli, config
from rthyb_rt.api.diagnosing import diagnose

RIG = """schema = "rthyb-rig/1"
rig = { name = "mine", elastic_stiffness_n_per_m = 6.7e5 }
actuator = { kind = "servo-hydraulic", moving_mass_kg = 40 }
[[specimen]]
element = "stiffness"
k_n_per_m = 6.7e5
"""
TEST = """schema = "rthyb-test/1"
rig = "mine.toml"
test = { name = "short", free_vibration_s = 0 }
ground_motion = { record = "elcentro-1940-ns", pga_g = 0.02, duration_s = 2 }
numerical = { period_s = 0.5, damping_ratio = 0.05 }
controller = { type = "paper", alpha0 = 20 }
"""
SAID = re.compile(r'ig "mine" omits (kp_per_s, .*) of its actuator')


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a rig file that gives the moving mass only, and a test on that rig."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(RIG)
    (tmp_path / "short.toml").write_text(TEST)
    return tmp_path


def said_once(texts: object) -> bool:
    """Return whether the note occurs once, with values, and without the value that was given."""
    text = texts if isinstance(texts, str) else "\n".join(map(str, texts))  # type: ignore[call-overload]
    found = SAID.findall(text)
    return len(found) == 1 and "moving_mass_kg" not in found[0] and "friction_n = 80" in text


COMMANDS = {
    "run": ["short.toml", "--out", "one", "--no-report"],
    "sweep": ["short.toml", "--over", "controller.w1=3,3.2,3.4", "--jobs", "1"],
    "compare-laws": ["short.toml", "--law", "paper", "--law", "robust"],
    "check": ["short.toml"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_says_once_which_values_the_rig_file_omits(
    lab: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main([command, *COMMANDS[command]])
    found = capsys.readouterr()
    assert said_once(found.out + found.err)


def test_a_campaign_says_once_what_each_of_its_rigs_omits(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (lab / "stiff.toml").write_text(RIG.replace('"mine"', '"stiff"').replace("= 40", "= 90"))
    (lab / "campaign.toml").write_text(
        'schema = "rthyb-campaign/1"\ncampaign = { name = "both", test = "short.toml" }\n'
        'noise_seeds = 2\n[over]\nrig = ["mine.toml", "stiff.toml"]\n'
    )
    cli.main(["campaign", "campaign.toml", "--jobs", "1", "--out", "both"])
    found = capsys.readouterr()
    assert said_once(found.out + found.err)
    assert found.err.count('rig "stiff" omits kp_per_s') == 1
    assert said_once((lab / "both" / "index.html").read_text().replace("&#34;", '"'))


def test_a_swept_key_is_not_said_to_be_omitted(lab: Path) -> None:
    found = rt.sweep("short.toml", {"rig.actuator.kp_per_s": [60, 63.5]}, out="kp", jobs=1)
    (note,) = (one for one in found.notes if "omits" in one)
    assert "omits ki_per_s2" in note
    assert "kp_per_s" not in note


def test_diagnosis_and_comparison_say_what_model_and_simulation_omit(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(["run", "short.toml", "--out", "one", "--no-report"])
    capsys.readouterr()
    cli.main(["compare", "one", "short.toml", "--out", "compared"])
    found = capsys.readouterr()
    assert said_once(found.out + found.err)
    cli.main(["diagnose", "one", "--model", "mine.toml"])
    found = capsys.readouterr()
    assert said_once(found.out + found.err)
    assert said_once(diagnose("one", rt.Rig("mine.toml")).notes)
    assert said_once(rt.compare("one", "short.toml").notes)


def test_recording_and_report_say_it_although_the_recorded_rig_has_every_value(lab: Path) -> None:
    rec = rt.run("short.toml", out="one")
    assert said_once(rec.notes)
    assert rec.rig["actuator.kp_per_s"] == 63.5
    again = rt.open("one")
    assert said_once(again.notices)
    assert said_once((lab / "one" / "report.html").read_text().replace("&#34;", '"'))
    (lab / "one" / "report.html").unlink()
    again.report("later.html")
    assert said_once((lab / "later.html").read_text().replace("&#34;", '"'))


def test_a_changed_copy_of_a_rig_still_omits_what_the_file_omits(lab: Path) -> None:
    mine = rt.Rig("mine.toml")
    assert said_once(rt.check("short.toml", mine.with_({"rig.seed": 3})).notes)
    given_all = mine.with_(actuator=dict(mine["actuator"]))
    assert not SAID.search("\n".join(rt.check("short.toml", given_all).notes))
    assert mine.with_({"rig.seed": 3}).with_({"rig.seed": 0}) == mine


def test_the_files_of_a_sweep_omit_it_too_so_that_resuming_says_it_again(lab: Path) -> None:
    rigs = [rt.Rig("mine.toml"), rt.Rig("mine.toml").with_({"rig.name": "other"})]
    for _ in range(2):
        found = rt.sweep("short.toml", {"rig": rigs}, out="rigs", jobs=1)
        assert said_once(found.notes)
        assert sum('rig "other" omits' in note for note in found.notes) == 1
    texts = {"rig.toml": config.dump_given(config.load_rig("mine.toml"))}
    assert "kp_per_s" not in texts["rig.toml"]
    assert config.parse_rig(texts["rig.toml"], "rig") == config.load_rig("mine.toml")


def test_each_axis_says_what_it_omits(lab: Path) -> None:
    text = Path(config.shipped_rig("two-axis-frame")).read_text()
    (lab / "two.toml").write_text(re.sub(r"(?m)^kp_per_s.*\n", "", text, count=1))
    two = rt.Rig("two.toml").with_({"rig.seed": 3})
    short = rt.Test("two-actuator-frame", ground_motion={"duration_s": 1})
    rec = rt.run(short, two)
    for texts in (rec.notes, rec.notices, rt.check(short, two).notes):
        (note,) = (one for one in texts if "omits" in one)
        assert note.lower().startswith('axis upper: rig "two-axis-frame.upper" omits kp_per_s of')
        assert "kp_per_s = 63.5" in note
