"""Draw the pictures of the guide from tests that the program runs for it.

``python docs/tools/pictures.py`` writes docs/images/*.svg, and report.png where chromium is found.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from rthyb_rt import config, report
from rthyb_rt.analysis import summary
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report.figures import draw_all

IMAGES = Path(__file__).resolve().parents[1] / "images"
MARGIN = 8.0
FONT = "font-family: system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


def run(test: Path) -> RecordedTest:
    """Return the recording of a test file on the rig that it names."""
    loaded = config.load_test(test)
    return virtual_time.run(
        experiment.prepare(loaded, config.load_rig(config.find_rig(loaded.rig)))
    )


def draw(rec: RecordedTest, prefix: str, keys: tuple[str, ...]) -> None:
    """Write figures of the report as SVG files."""
    for plate in draw_all(rec, summary.summarize(rec)):
        if plate.key not in keys:
            continue
        (IMAGES / f"{prefix}-{plate.key}.svg").write_text(on_paper(plate.svg), encoding="utf-8")


def on_paper(svg: str) -> str:
    """Return a figure as a file of its own on white paper, for light and dark pages."""
    head, rest = svg.split(">", 1)
    width, height = (float(n) for n in head.split('viewBox="0 0 ')[1].split('"')[0].split())
    box = f"{-MARGIN:g} {-MARGIN:g} {width + 2 * MARGIN:g} {height + 2 * MARGIN:g}"
    head = head.replace(f'viewBox="0 0 {width:.1f} {height:.1f}"', f'viewBox="{box}"')
    paper = f'<rect x="{-MARGIN:g}" y="{-MARGIN:g}" width="100%" height="100%" fill="#ffffff"/>'
    size = f'width="{(width + 2 * MARGIN) * 1.5:.0f}" style="{FONT}"'
    return f"{head} {size}>{paper}{rest}\n"


def photograph(rec: RecordedTest) -> None:
    """Write the top of the report as report.png, if there is a browser for it."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("no chromium: report.png stays as it is")
        return
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        page, shot = Path(folder) / "report.html", Path(folder) / "shot.png"
        report.write_report(rec, page)
        subprocess.run(
            [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
             "--no-first-run", "--disable-quic", "--disable-background-networking",
             "--disable-component-update", "--disable-sync", f"--user-data-dir={folder}/profile",
             "--force-device-scale-factor=1.5", "--window-size=1000,1330",
             f"--screenshot={shot}", page.as_uri()],
            check=True, capture_output=True,
        )  # fmt: skip
        with Image.open(shot) as image:
            image.convert("RGB").quantize(160).save(IMAGES / "report.png", optimize=True)


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    table = run(config.builtin_test_path())
    draw(table, "section5", ("displacement", "peak", "response", "delay", "stiffness"))
    draw(run(config.builtin_test_path().with_name("section4.2.toml")), "section4-2",
         ("hysteresis", "delay"))  # fmt: skip
    photograph(table)
