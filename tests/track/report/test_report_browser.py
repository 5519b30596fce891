"""How the pages of `rstrack report` behave in a headless Chromium; skipped where there is none, or no playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from report_util import (
    EPOCH_FRAMES,
    calibration,
    make_bench,
    make_epoch_run,
    make_run,
    make_sequence,
    make_stress,
    write_calibration,
)

from rsgen.console.tables import Table
from rstrack.report.build import write_report
from rstrack.report.page import Page, PageSection, Sortable, write_page

FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--enable-unsafe-swiftshader",
)  # fmt: skip


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sequence(tmp_path_factory.mktemp("sequence") / "twin", twin=True)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, twin: Path) -> Path:
    return write_report(make_run(tmp_path_factory.mktemp("runs") / "run", twin))


@pytest.fixture(scope="module")
def bench_report(tmp_path_factory: pytest.TempPathFactory, twin: Path) -> Path:
    plain = make_sequence(tmp_path_factory.mktemp("sequence") / "plain")
    root = tmp_path_factory.mktemp("bench")
    make_bench(root, plain, twin)
    return write_report(root)


@pytest.fixture(scope="module")
def stress_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("stress")
    make_stress(root)
    return write_report(root)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A browser without a window. The system's own: none is downloaded."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install '.[test]')")
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")
    with api.sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"), executable_path=found, headless=True, args=list(FLAGS), timeout=300_000
        )
        context.set_default_timeout(300_000)
        yield context
        context.close()


@pytest.fixture
def tab(browser: Any) -> Iterator[Any]:
    """A page of it, whose errors and requests are collected and must be none."""
    page, troubles = browser.new_page(), []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda message: troubles.append(message.text) if message.type == "error" else None)
    page.on("request", lambda r: None if r.url.startswith(("file:", "data:", "blob:")) else troubles.append(r.url))
    page.set_viewport_size({"width": 1000, "height": 800})
    yield page
    page.close()
    assert not troubles


DRAWN = "() => [...document.querySelectorAll('.plot')].filter(e => !e.closest('[hidden]')).every(e => e._fullLayout)"
EYE = "e => e._fullLayout.scene._scene.getCamera().eye"


def middle_pixels(tab: Any) -> np.ndarray:
    """The slider's picture as it is on the screen."""
    data = tab.locator(".stack").first.screenshot()
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)).astype(float)


def test_the_slider_moves_the_picture_by_keyboard_mouse_and_button(tab: Any, report: Path) -> None:
    tab.goto(report.as_uri())
    slider, stack = tab.locator(".compare input").first, tab.locator(".stack").first
    slider.focus()
    tab.keyboard.press("End")
    rolling = middle_pixels(tab)
    tab.keyboard.press("Home")
    still = middle_pixels(tab)
    inner = np.s_[4:-40, 4:-4]  # without the captions and the line
    assert np.abs(rolling - still)[inner].mean() > 3.0
    for _ in range(50):
        tab.keyboard.press("ArrowRight")
    assert slider.input_value() == "50"
    half, w = middle_pixels(tab), rolling.shape[1] // 2
    np.testing.assert_allclose(half[4:-40, 4 : w - 6], rolling[4:-40, 4 : w - 6], atol=3)
    np.testing.assert_allclose(half[4:-40, w + 6 : -4], still[4:-40, w + 6 : -4], atol=3)
    tab.locator(".flip").first.click()
    assert slider.input_value() == "0"
    tab.locator(".flip").first.click()
    assert slider.input_value() == "100"
    box = stack.bounding_box()
    tab.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 50)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 50)
    tab.mouse.up()
    assert abs(float(slider.input_value()) - 25) <= 1


def test_a_recordings_page_counts_from_its_first_frame_and_goes_by_the_run(tab: Any, tmp_path: Path) -> None:
    tab.goto(write_report(make_epoch_run(tmp_path)[1]).as_uri())
    tab.wait_for_function(DRAWN)
    plots = tab.locator("#time .plot, #tracker .plot")
    length_s = (EPOCH_FRAMES - 1) / 30
    assert plots.count() == 6
    for k in range(plots.count()):
        heading = plots.nth(k).get_attribute("aria-label")
        x, seen = plots.nth(k).evaluate("e => [e.data[0].x, e._fullLayout.xaxis.range]")
        wanted = length_s - (1.0 if heading.startswith("Drift") else 0.0)
        assert len(set(x)) > 60 and (x[0], x[-1]) == pytest.approx((0.0, wanted), abs=1e-3), heading
        assert -0.5 < seen[0] <= 0.0 and wanted - 1e-3 <= seen[1] < wanted + 0.5, heading
    assert tab.locator("#facts dd").first.text_content() == "stamped 1305031453.371 s"
    assert "colour 32×24, 26 ms readout and depth 32×24, 34 ms readout" in tab.locator(".subtitle").text_content()
    clocks = tab.locator("h2.row").all_text_contents()
    assert clocks[0] == "Truth's clock as stored" and clocks[1].startswith("Truth's clock fitted, -30.0 ± ")
    cards = tab.locator(".card", has_text="position error")
    assert cards.count() == 2 and all(cards.nth(k).is_visible() for k in range(2))
    sizes = cards.locator(".value").evaluate_all("all => all.map(e => getComputedStyle(e).fontSize)")
    stored_mm, fitted_mm = (float(text.split()[0]) for text in cards.locator(".value").all_text_contents())
    assert sizes[0] == sizes[1] and fitted_mm < 0.1 * stored_mm


def test_the_path_is_drawn_in_3d_and_can_be_turned(tab: Any, report: Path) -> None:
    tab.goto(report.as_uri())
    tab.wait_for_function(DRAWN)
    plot = tab.locator(".plot.solid")
    plot.scroll_into_view_if_needed()
    if not tab.evaluate("Boolean(document.createElement('canvas').getContext('webgl'))"):
        pytest.skip("this Chromium has no WebGL")
    assert plot.locator("canvas").count() >= 1 and tab.locator(".no-webgl").first.is_hidden()
    tab.wait_for_timeout(500)
    seen = cv2.imdecode(np.frombuffer(plot.screenshot(), np.uint8), cv2.IMREAD_COLOR)[80:-100]
    assert (np.ptp(seen.astype(int), axis=-1) > 40).sum() > 100, "no coloured path"
    before = plot.evaluate(EYE)
    turn = tab.locator(".turn input")
    turn.focus()
    for _ in range(30):
        tab.keyboard.press("ArrowRight")
    tab.wait_for_timeout(500)
    after = plot.evaluate(EYE)
    angle = np.arctan2(after["y"], after["x"]) - np.arctan2(before["y"], before["x"])
    assert np.degrees(angle) % 360 == pytest.approx(30.0, abs=1.0)
    box = plot.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    for k in range(1, 8):
        tab.mouse.move(x + 12 * k, y)
    tab.mouse.up()
    tab.wait_for_timeout(500)
    dragged = plot.evaluate(EYE)
    assert np.hypot(dragged["x"] - after["x"], dragged["y"] - after["y"]) > 0.1


def test_without_webgl_the_path_is_drawn_from_above(tab: Any, report: Path) -> None:
    tab.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {"
        "  return /webgl/.test(kind) ? null : get.call(this, kind, ...rest); };"
    )
    tab.goto(report.as_uri())
    tab.wait_for_function(DRAWN)
    assert tab.locator(".no-webgl").is_visible() and tab.locator(".turn").is_hidden()
    assert tab.locator(".plot.solid .scatterlayer .trace").count() == 2


@pytest.mark.parametrize("width", [1280, 400])
def test_the_benchmark_fits_any_width_and_shows_one_sequence_at_a_time(
    tab: Any, bench_report: Path, width: int
) -> None:  # fmt: skip
    tab.set_viewport_size({"width": width, "height": 800})
    tab.emulate_media(color_scheme="dark" if width == 400 else "light")
    tab.goto(bench_report.as_uri())
    tab.wait_for_function(DRAWN)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    ink = tab.evaluate("getComputedStyle(document.body).color")
    assert ink == ("rgb(231, 234, 240)" if width == 400 else "rgb(29, 33, 41)")
    options = tab.locator("#sequences .option")
    assert [options.nth(k).is_visible() for k in range(2)] == [True, False]
    tab.locator("#sequences select").select_option(label="lr_kt2")
    tab.wait_for_function(DRAWN)
    assert [options.nth(k).is_visible() for k in range(2)] == [False, True]
    names = options.nth(1).locator(".plot.solid").evaluate("e => e.data.map(trace => trace.name)")
    assert names == ["true", "baseline", "rs-pg"]
    assert options.nth(0).locator("canvas").count() == 0, "a hidden view gives its WebGL back"


@pytest.mark.parametrize("width", [1280, 400])
def test_the_stress_tests_page_fits_any_width_and_draws_the_chosen_path(
    tab: Any, stress_report: Path, width: int
) -> None:  # fmt: skip
    tab.set_viewport_size({"width": width, "height": 800})
    tab.emulate_media(color_scheme="dark" if width == 400 else "light")
    tab.goto(stress_report.as_uri())
    tab.wait_for_function(DRAWN)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    options = tab.locator("#color .option")
    assert [options.nth(k).is_visible() for k in range(2)] == [True, False]
    tab.locator("#color select").select_option(label="estimated path")
    tab.wait_for_function(DRAWN)
    assert [options.nth(k).is_visible() for k in range(2)] == [False, True]
    plot = options.nth(1).locator(".plot").first
    assert plot.locator(".scatterlayer .trace").count() == 2
    assert plot.locator(".scatterlayer .point").count() == 6
    panels = tab.locator("#keyframe .pictures img")
    assert panels.evaluate_all("all => all.map(image => [image.naturalWidth, image.naturalHeight])") == [[64, 48]] * 5
    tab.locator("#keyframe .flip").click()
    constant = middle_pixels(tab)
    tab.locator("#keyframe .flip").click()
    inner = np.s_[4:-40, 4:-4]  # without the captions and the line
    assert np.abs(constant - middle_pixels(tab))[inner].mean() > 3.0


@pytest.mark.parametrize("width", [1280, 400])
def test_the_calibrations_page_fits_any_width_and_gives_its_camera_file(
    tab: Any, browser: Any, tmp_path: Path, width: int
) -> None:
    data = calibration()
    tab.set_viewport_size({"width": width, "height": 800})
    tab.emulate_media(color_scheme="dark" if width == 400 else "light")
    tab.goto(write_report(write_calibration(tmp_path, data)).as_uri())
    tab.wait_for_function(DRAWN)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    cells = tab.locator("#where .plot")
    ink = "rgb(231, 234, 240)" if width == 400 else "rgb(29, 33, 41)"
    numbers = cells.locator(".heatmap-label")
    assert numbers.all_text_contents() == ["25", "75", "50", "50", "90", "10"]
    assert numbers.first.locator("text").evaluate("e => getComputedStyle(e).fill") == ink
    # The cells, the curves below and their names: nothing on top of each other.
    boxes = cells.evaluate(
        "e => [...e.querySelectorAll('.ytick, .y2tick, .y3tick')].map(tick => tick.getBoundingClientRect())"
        ".map(box => [box.left, box.top, box.right, box.bottom])"
    )
    for k, (left, top, right, bottom) in enumerate(boxes):
        assert left >= 0.0 and right <= width
        assert all(bottom <= b + 1 or d <= top + 1 or right <= a or c <= left for a, b, c, d in boxes[k + 1 :])
    browser.grant_permissions(["clipboard-read", "clipboard-write"])
    tab.locator(".copy").click()
    tab.wait_for_function("() => document.querySelector('.said').textContent")
    if tab.locator(".said").text_content() == "Copied.":
        assert tab.evaluate("navigator.clipboard.readText()") == data["camera_file"]
    else:
        assert tab.evaluate("getSelection().toString()").strip() == data["camera_file"].strip()


def test_a_click_on_a_heading_sorts_and_what_is_no_number_stays_last(tab: Any, tmp_path: Path) -> None:
    rows = (("b", "10.5", "10 of 10"), ("c", "missing", "9 of 10"), ("a", "9.25", "10 of 10"), ("d", "-0.5", "-"))
    table = Sortable(Table(("method", "ATE, mm", "scored"), rows))
    page = Page("Board", "", (), (PageSection("one", "One", (table,)),))
    tab.goto(write_page(page, tmp_path / "board.html").as_uri())
    heads = tab.locator("table.sortable thead button")

    def order() -> str:
        return "".join(text.strip() for text in tab.locator("tbody th").all_text_contents())

    assert order() == "bcad"
    heads.nth(1).click()
    assert order() == "dabc" and tab.locator("th[aria-sort='ascending']").text_content().startswith("ATE")
    heads.nth(1).focus()
    tab.keyboard.press("Enter")
    assert order() == "badc" and tab.locator("th[aria-sort='descending']").count() == 1
    heads.nth(0).click()
    assert order() == "abcd" and tab.locator("th[aria-sort]").count() == 1
