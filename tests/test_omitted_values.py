"""A rig file that omits values of its actuator: every command states the values that it used."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import cli, config
from rthyb_rt.api.diagnosing import diagnose
from rthyb_rt.rig.commissioning import certificate

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


# ---- files that the program writes --------------------------------------------------------------


def written_by_identify(lab: Path) -> None:
    cli.main(["identify", "mine.toml", "--out", "id.toml"])


def written_by_save(lab: Path) -> None:
    rt.Rig("mine.toml").save("id.toml")


def written_by_to_toml(lab: Path) -> None:
    (lab / "id.toml").write_text(rt.Rig.from_toml(rt.Rig("mine.toml").to_toml()).to_toml())


def written_by_the_identification(lab: Path) -> None:
    rt.identify("mine.toml").rig.save("id.toml")


def written_by_a_run(lab: Path) -> None:
    cli.main(["run", "short.toml", "--out", "one", "--no-report"])
    (lab / "id.toml").write_bytes((lab / "one" / "rig.toml").read_bytes())


def written_from_a_recording(lab: Path) -> None:
    rt.run("short.toml").rig.save("id.toml")


WRITERS = (
    written_by_identify, written_by_save, written_by_to_toml, written_by_the_identification,
    written_by_a_run, written_from_a_recording,
)  # fmt: skip


@pytest.mark.parametrize("write", WRITERS)
def test_a_written_rig_file_has_the_values_and_goes_on_saying_that_nobody_stated_them(
    lab: Path, write: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    write(lab)
    text = (lab / "id.toml").read_text()
    assert "\nkp_per_s = 63.5\n" in text
    assert 'assumed = ["actuator.kp_per_s", ' in text
    capsys.readouterr()
    cli.main(["check", "short.toml", "--set", "rig=id.toml"])
    found = capsys.readouterr()
    assert said_once(found.out + found.err)


def test_a_rig_that_states_everything_has_no_list(lab: Path) -> None:
    for name in rt.Rig.names():
        assert "assumed" not in rt.Rig(name).to_toml()


def test_a_recording_run_again_and_the_rig_read_back_are_the_same(lab: Path) -> None:
    rig = rt.Rig("mine.toml")
    assert rt.Rig.from_toml(rig.to_toml()) == rig
    rec = rt.run("short.toml")
    again = rt.run(rec.test, rec.rig)
    assert said_once(again.notes)
    np.testing.assert_array_equal(again["x_meas_m"], rec["x_meas_m"])


@pytest.fixture
def listed(lab: Path) -> str:
    """The text of a rig file that lists what nobody stated."""
    text = rt.Rig("mine.toml").to_toml()
    (lab / "id.toml").write_text(text)
    return text


def noted(*settings: str) -> str:
    return " ".join(config.omitted(config.load_any_both("short.toml", "id.toml", settings)[1]))


def test_a_value_that_is_set_leaves_the_list(listed: str) -> None:
    assert noted().startswith('rig "mine" omits kp_per_s, ki_per_s2')
    for value in (63.5, 40):
        said = noted(f"rig.actuator.kp_per_s={value}")
        assert said.startswith('rig "mine" omits ki_per_s2')
        assert "kp_per_s =" not in said
        changed = rt.Rig("id.toml").with_({"actuator.kp_per_s": value})
        assert "actuator.ki_per_s2" in changed["rig.assumed"]
        assert "actuator.kp_per_s" not in changed["rig.assumed"]
        assert rt.Rig.from_toml(changed.to_toml()) == changed
    whole = '{ kind = "servo-hydraulic", friction_n = 80 }'
    assert "friction_n" not in noted(f"rig.actuator={whole}")
    assert "kp_per_s" in noted(f"rig.actuator={whole}")
    assert "kp_per_s" in noted("rig.actuator.kind=servo-hydraulic")


def test_values_leave_the_list_with_the_kind_of_their_actuator(listed: str) -> None:
    assert noted('rig.actuator={ kind = "pure-delay", delay_samples = 9 }') == ""
    delay = rt.Rig("id.toml").with_({"actuator": {"kind": "pure-delay", "delay_samples": 9}})
    assert "assumed" not in delay.to_toml()


def test_a_value_corrected_in_the_file_is_stated_even_if_it_is_still_listed(
    lab: Path, listed: str
) -> None:
    (lab / "id.toml").write_text(listed.replace("\nkp_per_s = 63.5\n", "\nkp_per_s = 40\n"))
    assert noted().startswith('rig "mine" omits ki_per_s2')
    assert "actuator.kp_per_s" not in rt.Rig("id.toml")["rig.assumed"]


def test_without_the_list_every_value_is_stated(lab: Path, listed: str) -> None:
    (lab / "id.toml").write_text(re.sub(r"(?m)^assumed = .*\n", "", listed))
    assert noted() == ""
    (lab / "id.toml").write_text(listed)
    for none in ({"rig.assumed": None}, {"rig.assumed": []}):
        stated = rt.Rig("id.toml").with_(none)
        assert "assumed" not in stated.to_toml()
        assert stated["actuator.kp_per_s"] == 63.5


def test_a_name_in_the_list_that_is_no_such_key_is_refused_with_its_line(
    lab: Path, listed: str
) -> None:
    text = listed.replace('"actuator.kp_per_s"', '"actuator.kp_per_ss"')
    line = text[: text.index("assumed")].count("\n") + 1
    says = rf'id\.toml:{line}: rig\.assumed: found "actuator\.kp_per_ss".*actuator\.kp_per_s'
    (lab / "id.toml").write_text(text)
    with pytest.raises(rt.InputError, match=says):
        rt.Rig("id.toml")
    for name in ("actuator.kind", "friction_n", "rig.name"):
        with pytest.raises(rt.InputError, match=f'rig.assumed: found "{name}"'):
            rt.Rig("mine.toml").with_({"rig.assumed": [name]})
    with pytest.raises(rt.InputError, match="this rig has none"):
        rt.Rig("delay-10-elastic").with_({"rig.assumed": ["actuator.kp_per_s"]})


def test_the_list_does_not_change_what_a_commissioning_holds_for(listed: str) -> None:
    by_list, by_omission = config.load_rig("id.toml"), config.load_rig("mine.toml")
    stated = config.parse_rig(re.sub(r"(?m)^assumed = .*\n", "", listed))
    hashes = {certificate.rig_hash(rig) for rig in (by_list, by_omission, stated)}
    assert len(hashes) == 1


def test_axes_are_listed_by_name(lab: Path) -> None:
    text = Path(config.shipped_rig("two-axis-frame")).read_text()
    (lab / "two.toml").write_text(re.sub(r"(?m)^kp_per_s.*\n", "", text, count=1))
    two = rt.Rig("two.toml")
    (name,) = two["rig.assumed"]
    assert name == "axis.upper.actuator.kp_per_s"
    two.save("id.toml")
    assert rt.Rig("id.toml") == two
    before, after = (config.omitted(config.load_any_rig(file)) for file in ("two.toml", "id.toml"))
    assert len(after) == 1
    assert after == before
    setting = {"rig.axis.upper.actuator.kp_per_s": "63.5"}
    assert config.omitted(config.load_any_rig("id.toml", setting)) == []
    with pytest.raises(rt.InputError, match=r'rig\.assumed: found "actuator\.kp_per_s"'):
        two.with_({"rig.assumed": ["actuator.kp_per_s"]})
    config.parse_rig(config.dump(config.load_any_rig("id.toml").of_axis("upper")))


def test_a_comparison_of_recordings_says_what_their_rig_omits(lab: Path) -> None:
    rec = rt.run("short.toml")
    assert said_once(rt.compare(rec).notes)
    assert said_once(rt.compare(rec, rec).notes)
    sweep = rt.sweep("short.toml", {"controller.w1": [3, 3.2]}, out="w", jobs=1, keep="all")
    assert said_once(rt.compare(sweep).notes)
