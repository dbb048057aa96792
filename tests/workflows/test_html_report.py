"""The report in a real browser: that it opens by itself, shows everything and answers clicks."""

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal
from urllib.parse import unquote

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from playwright.sync_api import Page, sync_playwright

from pipeline.tables import SCHEMAS
from tests.scenes.runs import run_archive
from tests.support import pilotage
from workflows.cli import app
from workflows.html_report.rows import changes, collect
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample
from workflows.store import RunFolder

CHROMIUM = shutil.which("chromium")
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
             "--disable-sync", "--no-first-run"]  # fmt: skip
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
OPENS_WITHIN_S = 3.0
# Other programs share the machine: the best of so many counts.
TRIES = 3
FIGURES = 12
LARGEST_MB = 15.0


def _column(field: pa.Field, count: int, rng: np.random.Generator) -> pa.Array:
    """Plausible values of one column."""
    name = field.name
    if name == "image_id":
        return pa.array([f"N{1_500_000_000 + k}_1" for k in range(count)])
    if name == "time_utc":
        return pa.array(pd.date_range("2005-01-01", periods=count, freq="7min").strftime("%Y-%m-%dT%H:%M:%S"))
    if pa.types.is_floating(field.type):
        return pa.array(np.abs(rng.normal(size=count)) + 0.01, field.type)
    return pa.nulls(count, field.type)


def _write(folder: Path, name: str, count: int, **given: object) -> None:
    """One table of a made-up run, partitioned as a run's own."""
    rng = np.random.default_rng(len(name))
    schema = pa.schema([field for field in SCHEMAS[name] if field.name not in ("mission", "camera")])
    columns = [
        pa.array(given[field.name], field.type) if field.name in given else _column(field, count, rng)
        for field in schema
    ]
    place = folder / name / "mission=CASSINI" / "camera=NAC"
    place.mkdir(parents=True)
    # Row groups of some thousand images, as a run writes them.
    pq.write_table(pa.table(columns, schema=schema), place / "part.parquet", row_group_size=10_000)


@pytest.fixture(scope="module")
def hundred_thousand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, count = tmp_path_factory.mktemp("many"), 100_000
    failed = np.arange(count) % 20 == 0
    text = np.where(failed, "failed", "success").tolist()
    reason = np.where(failed, "no_match", "navigated").tolist()
    size = [1024] * count
    _write(folder, "offsets", count, status=text, status_reason=reason, rank=["high"] * count, rows=size, columns=size)
    _write(folder, "timings", count, stage=["total", "stars"] * (count // 2))
    names = ["BodyLimbNav", "BodyDiscCorrelateNav"]
    _write(folder, "techniques", count, technique=[names[k % 2] for k in range(count)],
           image_id=[f"N{1_500_000_000 + k // 2}_1" for k in range(count)])  # fmt: skip
    places = np.random.default_rng(1).uniform(0, 1023, (2, count))
    _write(folder, "features", count, used=[True] * count, measured_v_px=places[0], measured_u_px=places[1])
    (folder / "plan.json").write_text('{"images": []}')
    (folder / "run.json").write_text(json.dumps({"archive": "a whole mission"}))
    return folder


@pytest.fixture(scope="module")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("report")
    options = StarSampleOptions(frames=6, seed=3, cameras=("lorri_4x4", "cassini_nac"), processes=1)
    run_archive(make_star_sample(root / "archive", options), root / "run")
    return root / "run"


def _report(run: Path, *more: str) -> Path:
    app(["report", str(run), *more], standalone_mode=False)
    return run / "report.html"


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser.new_page(viewport={"width": 1400, "height": 900})
        browser.close()


def _open(page: Page, report: Path) -> list[str]:
    """Open a report, and return what the browser complains of or fetches beside it."""
    faults: list[str] = []
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: faults.append(request.url) if request.url.startswith("http") else None)
    page.goto(report.as_uri())
    page.wait_for_function("[...document.querySelectorAll('.plot')].every((plot) => plot.querySelector('.main-svg'))")
    return faults


# Each visible text of the page with its colour and that of the nearest painted thing behind it, as [r, g, b].
_TEXTS = """() => {
  const numbers = (text) => text.match(/[\\d.]+/g).map(Number);
  const found = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const element = walk.currentNode.parentElement, text = walk.currentNode.textContent.trim();
    if (!text || !element.getClientRects().length || element.closest("script, style, .modebar")) continue;
    const style = getComputedStyle(element);
    let behind = element, paint = [0, 0, 0, 0];
    while (behind && paint[3] === 0) {
      paint = numbers(getComputedStyle(behind).backgroundColor);
      behind = behind.parentElement;
    }
    found.push([text.slice(0, 40), numbers(element.closest("svg") ? style.fill : style.color), paint]);
  }
  return found;
}"""
AA_CONTRAST = 4.5


def _luminance(colour: list[float]) -> float:
    """Relative luminance by WCAG 2.1."""
    parts = np.array(colour[:3]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def _contrast(ink: list[float], paper: list[float]) -> float:
    bright, dim = sorted((_luminance(ink), _luminance(paper)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


@needs_chromium
@pytest.mark.slow
def test_a_hundred_thousand_images_open_quickly_and_whole(hundred_thousand: Path, page: Page) -> None:
    report = _report(hundred_thousand)
    assert report.stat().st_size < LARGEST_MB * 1e6
    seconds: list[float] = []
    while len(seconds) < TRIES and min(seconds, default=OPENS_WITHIN_S) >= OPENS_WITHIN_S:
        started = time.perf_counter()
        assert _open(page, report) == []
        seconds.append(time.perf_counter() - started)
    assert min(seconds) < OPENS_WITHIN_S
    assert page.locator(".plot").count() == FIGURES
    assert "95000 of 100000 images navigated" in page.locator("header").inner_text()
    for plot in page.locator(".plot").all():
        assert plot.locator(".point, .js-line").count() > 0, plot.get_attribute("id")


@needs_chromium
def test_hover_names_the_image_and_a_click_shows_it(small_run: Path, page: Page) -> None:
    report = _report(small_run)
    assert _open(page, report) == []
    plot = page.locator("#plot-field")
    plot.scroll_into_view_if_needed()
    box = plot.locator(".point").first.bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    hover = plot.locator(".hovertext").first
    hover.wait_for()
    page.mouse.click(*middle)
    title = page.locator("#picture-title").inner_text()
    assert title
    assert title in (hover.text_content() or "")
    assert page.locator("dialog[open]").count() == 1
    page.keyboard.press("Escape")
    assert page.locator("dialog[open]").count() == 0


@needs_chromium
def test_the_keyboard_reaches_images_and_every_figure_has_words(small_run: Path, page: Page) -> None:
    assert _open(page, _report(small_run)) == []
    button = page.locator("button.image").first
    button.focus()
    page.keyboard.press("Enter")
    assert page.locator("#picture-title").inner_text() == button.get_attribute("data-image")
    page.keyboard.press("Escape")
    page.locator("nav a", has_text="Strangest answers").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.closest('section').querySelector('h2').textContent") == (
        "Strangest answers"
    )
    for figure in page.locator("figure").all():
        assert figure.get_attribute("aria-label") == figure.locator("figcaption").inner_text()


@needs_chromium
def test_the_strangest_show_their_pictures_and_open_them(small_run: Path, page: Page, tmp_path: Path) -> None:
    run = Path(shutil.copytree(small_run, tmp_path / "run"))
    (run / "pictures").mkdir(exist_ok=True)
    for path in (run / "images").glob("*.json"):
        cv2.imwrite(str(run / "pictures" / f"{path.stem}.png"), np.full((40, 60, 3), 90, np.uint8))
    assert _open(page, _report(run)) == []
    thumbnails = page.locator(".thumbnail")
    solved = int((collect(RunFolder(run)).answers["status"] == "success").sum())
    assert thumbnails.count() == solved > 3
    widths = page.evaluate("[...document.querySelectorAll('.thumbnail img')].map((image) => image.naturalWidth)")
    assert widths == [60] * solved
    thumbnails.first.click()
    assert page.locator("#picture-title").inner_text() == thumbnails.first.get_attribute("data-image")
    page.keyboard.press("Escape")


@needs_chromium
def test_a_camera_looks_the_same_in_every_figure(small_run: Path, page: Page) -> None:
    assert _open(page, _report(small_run)) == []
    looks = page.evaluate(
        "[...document.querySelectorAll('.plot')].flatMap((plot) => plot.data.filter((trace) => trace.name)"
        ".map((trace) => [trace.name, (trace.marker && trace.marker.color) || trace.line.color]))"
    )
    cameras = set(collect(RunFolder(small_run)).answers["camera"])
    seen = {camera: {colour for name, colour in looks if name == camera} for camera in cameras}
    assert len(cameras) == 2
    assert all(len(colours) == 1 for colours in seen.values())
    assert len(set.union(*seen.values())) == 2


@needs_chromium
def test_a_narrow_screen_does_not_scroll_sideways(small_run: Path, page: Page) -> None:
    page.set_viewport_size({"width": 390, "height": 800})
    assert _open(page, _report(small_run)) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.set_viewport_size({"width": 1400, "height": 900})


@needs_chromium
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_stands_out_from_what_is_behind_it(
    small_run: Path, page: Page, scheme: Literal["light", "dark"]
) -> None:
    page.emulate_media(color_scheme=scheme)
    assert _open(page, _report(small_run)) == []
    page.wait_for_timeout(200)
    page.locator("button.image").first.click()
    pairs = page.evaluate(_TEXTS)
    page.keyboard.press("Escape")
    page.emulate_media(color_scheme="light")
    assert len(pairs) > 100
    faint = {said: round(_contrast(ink, paper), 2) for said, ink, paper in pairs if _contrast(ink, paper) < AA_CONTRAST}
    assert faint == {}
    paper = max((paper for _, _, paper in pairs), key=[paper for _, _, paper in pairs].count)
    assert (_luminance(paper) > 0.5) == (scheme == "light")


def test_pictures_are_found_from_where_the_page_lies(small_run: Path, tmp_path: Path) -> None:
    for output in (tmp_path / "elsewhere" / "page.html", small_run / "page.html"):
        output.parent.mkdir(exist_ok=True)
        app(["report", str(small_run), "--output", str(output)], standalone_mode=False)
        data = output.read_text().split('<script id="data" type="application/json">')[1].split("</script>")[0]
        place = output.parent / unquote(json.loads(data)["address"])
        assert place.resolve() == (small_run / "pictures").resolve()
    assert json.loads(data)["address"] == "pictures"


def test_the_same_run_gives_the_same_page(small_run: Path) -> None:
    first = _report(small_run).read_bytes()
    assert _report(small_run, "--compare", str(small_run)).read_bytes() != first
    assert _report(small_run).read_bytes() == first


def test_a_run_of_other_images_is_no_comparison(small_run: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(small_run, tmp_path / "other"))
    for path in (other / "offsets").rglob("*.parquet"):
        table = pq.ParquetFile(path).read()
        ids = pa.array([f"other_{k}" for k in range(len(table))])
        pq.write_table(table.set_column(table.schema.get_field_index("image_id"), "image_id", ids), path)
    assert "no image in common" in pilotage("report", small_run, "--compare", other).refusal()


def test_changes_tell_what_failed_what_was_solved_and_what_moved(small_run: Path) -> None:
    after = collect(RunFolder(small_run)).answers
    solved = list(after["image_id"][after["status"] == "success"])
    assert len(solved) >= 3
    before = after.copy()
    moved, lost, still = (before["image_id"] == image_id for image_id in solved[:3])
    before.loc[moved, "offset_dv_px"] += 5.0 * np.hypot(before["sigma_dv_px"], before["sigma_dv_px"])
    before.loc[still, "offset_du_px"] += 2.0 * np.hypot(before["sigma_du_px"], before["sigma_du_px"])
    before.loc[lost, "status"] = "failed"
    change = changes(before, after)
    assert (list(change.moved["image_id"]), change.solved, change.failed) == ([solved[0]], [solved[1]], [])
    assert float(change.moved["sigmas"].iloc[0]) == pytest.approx(5.0)
