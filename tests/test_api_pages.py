"""The pages on Python: their code runs as it is written, and every public name has its entry."""

from __future__ import annotations

import contextlib
import doctest
import importlib
import io
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rthyb_rt as rt
import rthyb_rt.api

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
REFERENCE = DOCS / "api-reference.md"
GUIDES = [
    *(pytest.param(p, id=p.name) for p in sorted(DOCS.glob("api*.md")) if p != REFERENCE),
    pytest.param(DOCS / "own-parts.md", id="own-parts.md", marks=pytest.mark.long),
]
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_DIGITS = re.compile(r"[-−]?\d+(?:\.\d+)?")


def same(shown: str, printed: str) -> bool:
    """Compare words exactly, numbers to 2 %: another compiler may round otherwise."""
    if _DIGITS.sub("0", shown) != _DIGITS.sub("0", printed):
        return False
    pairs = zip(_DIGITS.findall(shown), _DIGITS.findall(printed), strict=True)
    values = ((float(a.replace("−", "-")), float(b.replace("−", "-"))) for a, b in pairs)
    return all(a == pytest.approx(b, rel=0.02) for a, b in values)


@pytest.mark.long
@pytest.mark.parametrize("page", GUIDES)
def test_code_of_the_page_runs_as_it_is_written_and_prints_what_stands_below_it(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names: dict[str, object] = {"__name__": "page"}
    printed = ""
    blocks = _BLOCK.findall(page.read_text(encoding="utf-8"))
    assert sum(language == "python" for language, _ in blocks) >= 3
    for language, text in blocks:
        file = re.match(r"# (\w+\.py)\n", text)
        if language == "python" and file is not None:
            (tmp_path / file[1]).write_text(text, encoding="utf-8")
        elif language == "python":
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(text, page.name, "exec"), names)
            printed = out.getvalue()
        elif language == "text":
            assert same(text, printed), f"{page.name} shows\n{text}\nand it is\n{printed}"


def test_code_of_the_readme_runs_as_it_is_written() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (code,) = [text for language, text in _BLOCK.findall(text) if language == "python"]
    exec(compile(code, "README.md", "exec"), {})


def test_every_public_name_has_an_entry_in_the_reference_and_no_other_has() -> None:
    found = {}
    for entry in re.findall(r"^::: (\S+)$", REFERENCE.read_text(encoding="utf-8"), re.MULTILINE):
        home, _, name = entry.rpartition(".")
        thing = getattr(importlib.import_module(home), name)
        # The room of the diagnosis stands for its function.
        found[id(rt.diagnose if name == "diagnose" else thing)] = entry
    public = {id(getattr(rt, name)): name for name in rt.__all__ if name != "__version__"}
    assert [name for key, name in public.items() if key not in found] == []
    assert [entry for key, entry in found.items() if key not in public] == []


@pytest.mark.parametrize(
    "module", [one.name for one in pkgutil.iter_modules(rthyb_rt.api.__path__, "rthyb_rt.api.")]
)
def test_examples_of_the_docstrings_are_true(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = {name: getattr(rt, name) for name in rt.__all__}
    found = doctest.testmod(importlib.import_module(module), extraglobs=names)
    assert found.failed == 0


def test_every_public_method_says_what_it_does() -> None:
    for name in rt.__all__:
        thing = getattr(rt, name)
        for member, value in vars(thing).items() if isinstance(thing, type) else ():
            if not member.startswith("_") and (callable(value) or isinstance(value, property)):
                assert getattr(value, "__doc__", None), f"{name}.{member}"


def test_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocstrings", reason="builds the site: pip install --group docs")
    pytest.importorskip("latex2mathml", reason="builds the site: pip install --group docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "api-reference.html").read_text(encoding="utf-8")
    for name in rt.__all__:
        home = "open_recording" if name == "open" else name
        assert f'.{home}"' in page or name == "__version__", name
