"""The README and the guide say what is true of this tree: links, files, commands, keys, figures."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main

from rthyb_rt import cli, config, studies
from rthyb_rt.analysis import summary
from rthyb_rt.cli import commands
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.core.laws import LAWS
from rthyb_rt.diagnose import catalogue, effects
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_rig, experiment, virtual_time
from rthyb_rt.rig import identification
from rthyb_rt.studies.results import Study

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ROOT / "docs" / "tools"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
sys.path.insert(0, str(TOOLS))

import key_tables  # noqa: E402
import study_tables  # noqa: E402

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\]\(([^()\s]+)\)")
_NUMBER = re.compile(r"(?<![\w.])[-−]?\d+(?:\.\d+)?")

IDENTIFIED = "my-rig-identified.toml"
"""The rig file that the guide has its reader make by `rthyb identify`."""

by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(language: str) -> Iterator[tuple[str, str]]:
    """Give (page name, text) of every fenced block in a language."""
    for page in PAGES:
        for match in _FENCE.finditer(read(page)):
            if match[1] == language:
                yield page.name, match[2]


def prose(page: Path) -> str:
    """Return the page without fenced blocks."""
    return _FENCE.sub("", read(page))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as web sites make them."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE):
        plain = re.sub(r"[^\w\- ]", "", heading.lower())
        found.add(plain.replace(" ", "-"))
    return found


# ---- pages --------------------------------------------------------------------------------------


@by_page
def test_every_link_and_picture_exists(page: Path) -> None:
    links = _LINK.findall(prose(page))
    for link in links:
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.is_file(), f"{page.name}: {link}"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}"


@by_page
def test_no_page_is_lost(page: Path) -> None:
    if page.name in ("README.md", "index.md"):
        return
    assert f"({page.name})" in read(ROOT / "docs" / "index.md")
    assert f"(docs/{page.name})" in read(ROOT / "README.md")
    assert f"- {page.name}\n" in read(ROOT / "mkdocs.yml")


def test_pictures_are_small_and_shown() -> None:
    pages = "".join(read(page) for page in PAGES)
    for picture in (ROOT / "docs" / "images").iterdir():
        assert picture.stat().st_size < 200_000, picture.name
        assert picture.name in pages, picture.name


@by_page
def test_files_named_in_the_text_exist(page: Path) -> None:
    for name in re.findall(r"`((?:examples|hw|csrc|rthyb_rt|docs|tests)/[\w./-]*)`", read(page)):
        assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_safety_note_is_in_readme_and_guide() -> None:
    note = (
        "software limits protect a test, never a person; the hard-wired emergency stop is "
        "outside this software."
    )
    for page in (ROOT / "README.md", ROOT / "docs" / "safety.md"):
        assert note in " ".join(read(page).lower().replace("*", "").split())


# ---- the layout of the repository ----------------------------------------------------------------


def outline() -> list[str]:
    text = read(ROOT / "README.md").split("## Repository layout")[1]
    block = _FENCE.search(text)
    assert block is not None
    return [line.split()[0] for line in block[2].splitlines()]


def test_outline_names_only_what_is_there() -> None:
    for name in outline():
        path = ROOT / name
        assert path.is_dir() if name.endswith("/") else path.is_file(), name


def test_outline_has_every_top_level_folder() -> None:
    command = ["git", "-C", str(ROOT), "ls-files", "-co", "--exclude-standard"]
    try:
        listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    folders = {name.split("/")[0] + "/" for name in listed.splitlines() if "/" in name}
    assert folders <= set(outline())


# ---- configuration ------------------------------------------------------------------------------


def test_files_that_claim_a_schema_load_and_fit_a_rig(tmp_path: Path) -> None:
    rigs = {IDENTIFIED: tmp_path / IDENTIFIED}
    tests = []
    for page, text in blocks("toml"):
        schema = tomllib.loads(text).get("schema", "")
        if schema == config.rigfile.RIG_SCHEMA:
            rig = config.parse_any_rig(text, page)
            if isinstance(rig, config.AxesRig):
                CoupledRig(axes_rig.rig_config(rig))
                continue
            experiment.rig_config(rig)
            if page == "own-specimen.md" and rig.link is None:
                found = identification.identified_rig(rig, identification.identify(rig))
                rigs[IDENTIFIED].write_text(config.dump(found), encoding="utf-8")
        elif schema == config.campaignfile.CAMPAIGN_SCHEMA:
            assert config.parse_campaign(text, page).over
        elif schema:
            tests.append((page, text))
    assert tests
    assert rigs[IDENTIFIED].is_file()
    for page, text in tests:
        test = config.parse_test(text, page)
        assert test.rig is not None
        path = rigs.get(test.rig) or config.shipped_rig(test.rig)
        assert experiment.prepare(test, config.load_rig(path)).ticks > 0


def test_parts_of_files_are_valid_where_they_stand() -> None:
    head = 'schema = "rthyb-test/1"\n[test]\nname = "part"\n'
    rig_head = (
        'schema = "rthyb-rig/1"\n[rig]\nname = "part"\nelastic_stiffness_n_per_m = 1e6\n'
        '[actuator]\nkind = "pure-delay"\ndelay_samples = 1\n'
    )
    parts = [(p, t) for p, t in blocks("toml") if "schema" not in tomllib.loads(t)]
    assert parts
    for page, text in parts:
        if not text.startswith("["):
            _valid_values(text)
        elif text.startswith("[[specimen]]"):
            experiment.rig_config(config.parse_rig(rig_head + text, page))
        elif text.startswith("[numerical."):
            config.parse_test(head + text, page)
        else:
            config.parse_test(head + "[numerical]\nperiod_s=1\ndamping_ratio=0\n" + text, page)


def _valid_values(text: str) -> None:
    """Every key with its value must be taken by some table of the models."""
    ranges: dict[str, Any] = {}
    for model in (*_tables(config.TestFile), *_tables(config.RigFile)):
        for key, info in model.model_fields.items():
            parts = [*key_tables._parts(info.annotation), *info.metadata]
            for part in parts:
                if key_tables._is_limit(part):
                    part = part.model_fields["value"].metadata[0]
                if isinstance(part, config.fields.Range):
                    ranges[key] = part
    for key, value in tomllib.loads(text).items():
        assert ranges[key].read(value) > 0.0


def _tables(model: Any) -> Iterator[Any]:
    for _, found in key_tables._sections(model):
        yield from found


def test_messages_of_the_guide_are_those_of_the_program() -> None:
    """The longest fixed part of a message tells that it still reads so."""
    found = "".join(_messages())
    listed = [line for _, text in blocks("text") for line in text.splitlines()]
    listed = [line for line in listed if line.startswith("rthyb: ")]
    assert len(listed) >= 8
    for line in listed:
        message = line.rsplit(": ", 1)[1] if "did you mean" not in line else line
        kernel = message.split("; ")[-1].removesuffix(" ...").removesuffix(",")
        assert kernel in found, line


def _messages() -> Iterator[str]:
    test = """schema = "rthyb-test/1"
    test.name = "t"
    ground_motion.pga_g = 9.8
    [numerical]
    mass_kg = "4220 N"
    period_s = 0.5
    damping_ratio = "2 %"
    [controller]
    type = "papr"
    w1 = 0.5
    alfa0 = 17
    """
    rig = """schema = "rthyb-rig/1"
    rig.name = "r"
    actuator = { kind = "pure-delay", delay_samples = 10.5 }
    [[specimen]]
    element = "stifness"
    """
    for parse, text in ((config.parse_test, test), (config.parse_rig, rig)):
        with pytest.raises(InputError) as caught:
            parse(text)
        yield str(caught.value)
    minimal = 'test.name="t"\nnumerical={period_s=1, damping_ratio=0}\n'
    rig_file = config.load_rig(config.shipped_rig("delay-10-elastic"))
    with pytest.raises(InputError) as caught:
        config.derive(
            config.parse_test('schema="rthyb-test/1"\n' + minimal),
            rig_file.model_copy(update={"identified": None}),
        )
    yield str(caught.value)


# ---- generated tables ---------------------------------------------------------------------------


def test_tables_of_keys_and_fields_are_up_to_date() -> None:
    page = read(ROOT / "docs" / "file-formats.md")
    assert sorted(key_tables.names(page)) == sorted(key_tables.tables())
    assert key_tables.renewed(page, key_tables.tables()) == page, "run docs/tools/key_tables.py"


def test_catalogue_of_effects_is_that_of_the_program() -> None:
    """An effect that is added has its section, its picture, and what it is confused with."""
    pytest.importorskip("matplotlib", reason="the pictures of the catalogue")
    import effect_pages

    assert effect_pages.page() == read(ROOT / "docs" / "effects.md"), (
        "run docs/tools/effect_pages.py"
    )
    known = catalogue.entries()
    assert set(effect_pages.EXAMPLES) | set(effect_pages.CHANGES) == set(known)
    assert {name for pair in catalogue.PAIRS for name in pair[:2]} == set(known)
    for name in known:
        picture = f"effect-{effect_pages.file_name(name)}.svg"
        assert (ROOT / "docs" / "images" / picture).is_file(), "run docs/tools/effect_pages.py"


def test_an_effect_without_a_section_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib", reason="the pictures of the catalogue")
    import effect_pages

    rocking = type("Rocking", (effects.Effect,), {"name": "rocking", "equation": "f = m g sgn(x)"})
    monkeypatch.setitem(effects._REGISTER, "rocking", rocking())
    assert effect_pages.page() != read(ROOT / "docs" / "effects.md")


def test_a_picture_shows_what_its_effect_adds() -> None:
    """Friction over velocity jumps at rest: its curve has both levels, with their sign."""
    pytest.importorskip("matplotlib", reason="the pictures of the catalogue")
    import effect_pages

    known = catalogue.entries()
    *_, (v, (added,), _, ordinate) = effect_pages.panels_of_force(known["coulomb"])
    assert ordinate == "what is added, N"
    assert added[v > 10.0] == pytest.approx(600.0)
    assert added[v < -10.0] == pytest.approx(-600.0)
    (x, (longer,), _, _) = effect_pages.panels_of_actuator(known["act_gain"])[1]
    assert longer == pytest.approx(-0.1 * x)
    assert effect_pages.picture(known["coulomb"]).startswith("<svg")


def test_flags_and_states_of_the_guide_are_those_of_the_core() -> None:
    page = read(ROOT / "docs" / "file-formats.md")
    for name, bit in FLAGS.items():
        assert f"| {bit} | {name} |" in page
    assert ", ".join(f"{i} {name}" for i, name in enumerate(STATES)) in page


@pytest.mark.long
@pytest.mark.parametrize("section", studies.SECTIONS)
def test_paper_tables_are_what_the_studies_compute(section: str, paper: list[Study]) -> None:
    pytest.importorskip("pyslammer", reason="Section 4.2 needs the record TCU068")
    page = read(ROOT / "docs" / "paper.md")
    wanted = study_tables._section(next(study for study in paper if study.key == section))
    shown = page.split(f"<!-- generated: {section} -->\n\n")[1].split("\n\n<!-- end -->")[0]
    same_but_for_digits(shown, wanted, "run docs/tools/study_tables.py")


def same_but_for_digits(shown: str, wanted: str, hint: str) -> None:
    """Compare words exactly, numbers to 2 %: another compiler may round otherwise."""
    assert _NUMBER.sub("0", shown) == _NUMBER.sub("0", wanted), hint
    for a, b in zip(_NUMBER.findall(shown), _NUMBER.findall(wanted), strict=True):
        x, y = float(a.replace("−", "-")), float(b.replace("−", "-"))
        assert x == pytest.approx(y, rel=0.02, abs=0.02), f"{a}, now {b}; {hint}"


# ---- what the program prints --------------------------------------------------------------------


@cache
def built_in_table() -> dict[str, str]:
    test = config.load_test(config.builtin_test_path())
    rig = config.load_rig(config.find_rig(test.rig))
    return {
        row.label: row.value
        for row in summary.result_table(virtual_time.run(experiment.prepare(test, rig)))
    }


@pytest.mark.parametrize("name", ["README.md", "docs/first-test.md"])
def test_result_table_is_that_of_the_built_in_test(name: str) -> None:
    table = built_in_table()
    compared = 0
    for match in _FENCE.finditer(read(ROOT / name)):
        for line in match[2].splitlines():
            label = next((label for label in table if line.startswith(label + "  ")), None)
            if label is not None:
                value = line[len(label) :].strip()[: len(table[label])]
                same_but_for_digits(value, table[label], f"{name}: {label}")
                compared += 1
    assert compared >= 5


@pytest.mark.long
def test_check_table_is_that_of_the_specimen_of_the_guide(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = "own-specimen.md"
    rig, test, *_ = (text for name, text in blocks("toml") if name == page)
    rig_file = config.parse_rig(rig, page)
    found = identification.identified_rig(rig_file, identification.identify(rig_file))
    (tmp_path / IDENTIFIED).write_text(config.dump(found), encoding="utf-8")
    (tmp_path / "my-test.toml").write_text(test, encoding="utf-8")
    assert cli.main(["check", str(tmp_path / "my-test.toml")]) == 0
    printed = {line.split("  ")[0]: line for line in capsys.readouterr().out.splitlines()}
    shown = [text for name, text in blocks("text") if name == page and "Critical delay" in text]
    for line in shown[0].splitlines():
        same_but_for_digits(
            " ".join(line.split()), " ".join(printed[line.split("  ")[0]].split()), page
        )


# ---- the command line ---------------------------------------------------------------------------

PROGRAM: Any = typer.main.get_command(commands.app)


def command_lines() -> list[tuple[str, str]]:
    lines = [(page, line) for page, text in blocks("sh") for line in text.splitlines()]
    return [(page, line) for page, line in lines if line.startswith("rthyb ")]


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_command_line_is_understood(page: str, line: str) -> None:
    if page == "extending.md":
        # The law that the page builds is not in this program; tests/test_extending.py runs it.
        line = line.replace("controller.type=slope", "controller.type=alpha-beta")
    words = shlex.split(line.split(" > ")[0])[1:]
    assert words[0] in PROGRAM.commands, f"{page}: {line}"
    command, rest = PROGRAM.commands[words[0]], list(words[1:])
    if hasattr(command, "commands"):
        command = command.commands[rest.pop(0)]
    context = command.make_context(words[0], rest)
    for_test, for_rig = config.split_overrides(context.params.get("settings") or ())
    config.load_test(config.builtin_test_path(), for_test)
    config.load_rig(config.shipped_rig("shaking-table-portal-frame"), for_rig)
    for word in words[1:]:
        if word.startswith("examples/"):
            assert (ROOT / word).is_file(), f"{page}: {line}"


def test_readme_and_reference_list_every_command_and_no_other() -> None:
    readme = set(re.findall(r"^\| `rthyb ([\w-]+)", read(ROOT / "README.md"), re.MULTILINE))
    page = read(ROOT / "docs" / "command-line.md")
    sections = set(re.findall(r"^## `rthyb ([\w-]+)`", page, re.MULTILINE))
    assert readme == sections == set(PROGRAM.commands)


@pytest.mark.parametrize("name", sorted(PROGRAM.commands))
def test_reference_names_every_option(name: str) -> None:
    page = read(ROOT / "docs" / "command-line.md")
    section = page.split(f"## `rthyb {name}`")[1].split("\n## ")[0]
    command = PROGRAM.commands[name]
    parts = [command, *getattr(command, "commands", {}).values()]
    options = {option for part in parts for item in part.params for option in item.opts}
    options = {option for option in options if option.startswith("--")} - {"--help"}
    listed = set(re.findall(r"--[a-z][a-z-]*", section))
    assert listed - {"--help"} == options


def test_make_targets_of_the_guide_exist() -> None:
    makefile = read(ROOT / "Makefile")
    targets = {target for page in PAGES for target in re.findall(r"`make (\w+)`", read(page))}
    assert targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


# ---- equations ----------------------------------------------------------------------------------


@pytest.mark.long
def test_functions_named_beside_the_equations_exist() -> None:
    sources = [*(ROOT / "csrc").glob("*.[ch]"), *(ROOT / "rthyb_rt").rglob("*.py")]
    code = "\n".join(read(source) for source in sources)
    names = set(re.findall(r"`([a-z]\w*_\w+)`", read(ROOT / "docs" / "equations.md")))
    assert len(names) > 30
    for name in names:
        assert re.search(rf"\b{name}\b", code), name


def test_every_element_and_actuator_has_its_formula() -> None:
    page = read(ROOT / "docs" / "equations.md")
    kinds = dict(key_tables._sections(config.RigFile))
    for model in (*kinds["specimen"], *kinds["actuator"]):
        assert f"| `{key_tables._tag(model)}` |" in page


def test_every_setting_of_a_law_is_said_to_be_published_or_chosen() -> None:
    """Each setting that is not the rig's stands once, in the column of numbers or of choices."""
    section = read(ROOT / "docs" / "tuning.md").partition("## What is published")[2]
    rows = re.findall(
        r"^\| `\"([\w-]+)\"` \| (.*) \|$", section.partition("\n## ")[0], re.MULTILINE
    )
    assert {name for name, _ in rows} >= {"kf-adc", "darby", "ahmadizadeh", "ats", "amb"}
    for name, row in rows:
        _, published, chosen = row.split(" | ")
        own = {p.key.rpartition(".")[2] for p in LAWS[name].parameters if p.rig_key is None}
        named = re.findall(r"`(\w+)`", f"{published} {chosen}")
        assert sorted(named) == sorted(own), name


def test_what_make_run_installs_is_enough_for_the_examples_and_the_code_of_the_readme() -> None:
    (extras,) = re.findall(r"-e '\.\[([\w,]+)\]'", read(ROOT / "Makefile"))
    given = tomllib.loads(read(ROOT / "pyproject.toml"))["project"]["optional-dependencies"]
    installed = {re.split(r"\W", need)[0] for extra in extras.split(",") for need in given[extra]}
    assert {"matplotlib", "jinja2", "pandas", "scipy", "qdldl"} <= installed
