"""The page as a person meets it: opened from the disk in a real browser, looked at, clicked, typed into."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from ocnf_data.report.page import PageWriter
from ocnf_data.report.run import write_report

if TYPE_CHECKING:
    from playwright.sync_api import Browser
    from playwright.sync_api import Page as Tab


@pytest.fixture(scope="module")
def shared_tab(browser: Browser) -> Iterator[tuple[Tab, list[str]]]:
    """A tab, and what went wrong in it: errors and warnings, requests to anywhere but the disk."""
    tab, wrong = browser.new_page(viewport={"width": 1200, "height": 800}), []
    tab.on("console", lambda message: wrong.append(message.text)
           if message.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("request", lambda request: None if request.url.startswith(("file:", "data:", "blob:"))
           else wrong.append(request.url))
    tab.set_default_timeout(20_000)
    yield tab, wrong
    tab.close()


@pytest.fixture
def tab(shared_tab: tuple[Tab, list[str]], report_made: Any) -> Iterator[Tab]:
    """The gallery of the page."""
    found, wrong = shared_tab
    found.goto("about:blank")
    found.goto(report_made.page.as_uri())
    yield found
    assert wrong == []


def open_sample(tab: Tab, key: str) -> None:
    tab.click(f".card[data-key='{key}']")
    tab.wait_for_selector(f"html[data-sample='{key}']")
    settle(tab)


def settle(tab: Tab) -> None:
    """Until what has changed is drawn: two frames."""
    tab.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def widths(tab: Tab, selector: str) -> list[int]:
    """Widths of pictures in their own pixels, once they are decoded."""
    return [one.evaluate("one => one.decode().then(() => one.naturalWidth)")
            for one in tab.locator(selector).all()]


def picture(tab: Tab) -> np.ndarray:
    """The canvas with labels hidden, (H, W, 3) float, 0 to 1."""
    tab.add_style_tag(content="#panes, #gizmo { opacity: 0 }")
    settle(tab)
    shot = tab.locator("#canvas").screenshot()
    image = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR).astype(np.float32) / 255
    return image[12:-12, 12:-12]


def silhouette(image: np.ndarray) -> np.ndarray:
    """Where something is drawn: what differs from the corner's colour."""
    return np.abs(image - image[0, 0]).max(axis=2) > 0.05


def test_it_opens_from_the_disk_without_an_error(tab: Tab) -> None:
    assert tab.title() == tab.inner_text("h1") == "own"
    assert tab.locator(".card").count() == 3
    assert tab.inner_text("#tabs").split("\n") == ["Gallery (3)", "Statistics", "Failures (1)", "Provenance"]
    assert widths(tab, ".card img") == [200] * 3
    for name, text in (("Statistics", "By category"), ("Failures", "mug-broken"), ("Provenance", "rig: ")):
        tab.click(f"#tabs >> text={name}")
        assert text in tab.inner_text(f"#tab-{name.lower()}") and tab.is_hidden("#tab-gallery")


def test_the_canvas_shows_the_sample_and_a_click_swaps_its_surface(tab: Tab) -> None:
    open_sample(tab, "chair-a")
    shown = {}
    for number, name in enumerate(("Mesh", "Noisy input", "VolFus", "Ground truth"), 1):
        if number % 2:
            tab.click(f"[data-surface='{name}']")
        else:
            tab.keyboard.press(str(number))
        settle(tab)
        assert tab.inner_text("#panes b") == name
        assert tab.get_attribute(f"[data-surface='{name}']", "aria-pressed") == "true"
        assert tab.locator("[data-surface][aria-pressed=true]").count() == 1
        shown[name] = picture(tab)
        assert 0.005 < silhouette(shown[name]).mean() < 0.9, name
    for a, b in pairwise(shown):
        assert (np.abs(shown[a] - shown[b]).max(axis=2) > 0.1).mean() > 0.01, (a, b)
    mesh, truth = silhouette(shown["Mesh"]), silhouette(shown["Ground truth"])
    assert (mesh & truth).sum() / (mesh | truth).sum() > 0.6  # the same thing, from the same place
    assert tab.locator("canvas").count() - tab.locator(".side canvas").count() == 1


def test_the_browser_unpacks_what_was_packed(tab: Tab, report_made: Any, read_page: Any) -> None:
    page, sample = read_page(report_made.page)
    for number in range(len(page["samples"])):
        arrays, meta = sample(number)
        found = tab.evaluate(
            "number => ocnf.load(number).then(({ arrays, meta }) => [meta, Object.fromEntries("
            "Object.entries(arrays).map(([name, one]) => [name, Array.from(one.data)]))])", number)
        assert found[0] == meta and found[1].keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[1][name], array.reshape(-1), err_msg=name)


@pytest.mark.parametrize("key", ["chair-a", "mug-b"])
def test_the_first_view_is_that_of_the_thumbnail(tab: Tab, report_made: Any, read_page: Any,
                                                 key: str) -> None:
    """Two ways to draw one mesh: the silhouettes, each cut out and brought to the same size, agree."""
    page, _ = read_page(report_made.page)
    [encoded] = [row["thumbnail"] for row in page["samples"] if row["key"] == key]
    thumbnail = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR) / 255
    open_sample(tab, key)
    tab.click("[data-surface='Mesh']")
    cut = []
    for image in (thumbnail, picture(tab)):
        mask = silhouette(image)
        rows, columns = (np.flatnonzero(mask.any(axis=axis))[[0, -1]] for axis in (1, 0))
        part = mask[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1]
        cut.append((part.shape[0] / part.shape[1], cv2.resize(part.astype(np.uint8), (96, 96)) > 0))
    assert abs(np.log(cut[0][0] / cut[1][0])) < 0.08
    assert (cut[0][1] & cut[1][1]).sum() / (cut[0][1] | cut[1][1]).sum() > 0.85


def test_turning_zooming_and_resetting(tab: Tab) -> None:
    open_sample(tab, "mug-b")
    tab.click("[data-surface='Ground truth']")
    first = picture(tab)
    box = tab.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x + 150, y + 60, steps=3)
    tab.mouse.up()
    turned = picture(tab)
    assert (np.abs(turned - first).max(axis=2) > 0.05).mean() > 0.02
    tab.mouse.wheel(0, -600)
    assert silhouette(picture(tab)).sum() > 1.2 * silhouette(turned).sum()
    tab.click("#reset")
    assert np.abs(picture(tab) - first).max() < 0.02


def test_error_wireframe_clip_and_cube(tab: Tab) -> None:
    open_sample(tab, "chair-a")
    tab.click("[data-surface='VolFus']")
    plain = picture(tab)
    tab.check("#error")
    coloured = picture(tab)
    colourfulness = [np.ptp(image[silhouette(image)], axis=1).mean() for image in (plain, coloured)]
    assert colourfulness[1] > 2 * colourfulness[0]
    legend = tab.inner_text("#error-legend")
    assert "3 and more" in legend and "281 mm" in legend and "93.8 mm" in legend  # 3 m / 32 voxels
    assert "mean distance to the ground truth" in tab.inner_text("#panes")
    tab.uncheck("#error")
    for key in ("w", "b"):
        tab.keyboard.press(key)
        assert (np.abs(picture(tab) - plain).max(axis=2) > 0.05).mean() > 0.005, key
        tab.keyboard.press(key)
        assert np.abs(picture(tab) - plain).max() < 0.02, key
    tab.select_option("#clip-axis", "z")
    halves = []
    for _ in range(2):
        halves.append(silhouette(picture(tab)))
        tab.click("#clip-flip")
    whole = silhouette(plain)
    assert all(0.02 < half.sum() / whole.sum() < 0.98 for half in halves)
    assert (halves[0] | halves[1])[whole].mean() > 0.97  # what one side lacks, the other has
    rows = [np.nonzero(half)[0].mean() for half in halves]
    assert abs(rows[0] - rows[1]) > 20 and "z = " in tab.inner_text("#clip-value")


def test_side_by_side_with_one_camera(tab: Tab) -> None:
    open_sample(tab, "mug-b")
    tab.click("[data-layout='2']")
    settle(tab)
    assert tab.locator("#panes b").all_inner_texts() == ["Mesh", "Ground truth"]
    tab.mouse.move(400, 300)
    tab.mouse.down()
    tab.mouse.move(480, 330, steps=3)
    tab.mouse.up()
    image = silhouette(picture(tab))
    middle = image.shape[1] // 2
    left, right = image[:, 8 : middle - 20], image[:, middle + 20 : -8]
    assert left.mean() > 0.02 and right.mean() > 0.02
    for axis in (0, 1):  # as high and as wide, at the same height
        spans = [np.nonzero(half.any(axis=axis))[0][[0, -1]] for half in (left, right)]
        assert abs(int(np.ptp(spans[0])) - int(np.ptp(spans[1]))) < 0.15 * image.shape[0]
    tab.click("[data-layout='all']")
    settle(tab)
    assert tab.locator("#panes b").all_inner_texts() == ["Mesh", "Noisy input", "VolFus", "Ground truth"]
    quarters = [silhouette(quarter[14:-14, 14:-14]).mean() for half in np.array_split(picture(tab), 2)
                for quarter in np.array_split(half, 2, axis=1)]
    assert min(quarters) > 0.01


def test_the_gallery_is_filtered_and_sorted(tab: Tab, report_made: Any, read_page: Any) -> None:
    page, _ = read_page(report_made.page)

    def keys() -> list[str]:
        return [card.get_attribute("data-key") for card in tab.locator(".card").all()]

    everything = [row["key"] for row in page["samples"]]
    assert keys() == everything and tab.inner_text("#count") == "3 samples"
    tab.select_option("#category", "mug")
    assert sorted(keys()) == ["mug-b", "mug-c"] and tab.inner_text("#count") == "2 of 3 samples"
    tab.fill("#search", "C.ply")
    assert keys() == ["mug-c"]
    tab.fill("#search", "no such thing")
    assert keys() == [] and tab.is_visible("#nothing")
    tab.click("#clear")
    assert keys() == everything
    for column, heading in enumerate(page["columns"]):
        tab.select_option("#sort", str(column))
        ascending = [row["key"] for row in sorted(page["samples"], key=lambda row: row["values"][column])]
        assert keys() == ascending and heading["label"] in (tab.text_content(".card .value >> nth=0") or "")
        tab.check("#descending")
        assert keys() == ascending[::-1]
        tab.uncheck("#descending")
    tab.select_option("#sort", "key")
    assert keys() == sorted(everything)


def test_keys_addresses_and_the_way_back(tab: Tab) -> None:
    tab.select_option("#sort", "key")
    open_sample(tab, "chair-a")
    assert tab.is_disabled("#previous") and tab.inner_text("#position") == "1 of 3"
    tab.keyboard.press("ArrowRight")
    tab.wait_for_selector("html[data-sample='mug-b']")
    assert tab.url.endswith("#sample/mug-b") and tab.inner_text("#sample-key") == "mug-b"
    address = tab.url
    tab.keyboard.press("Escape")
    assert tab.is_hidden("#viewer") and "#sample" not in tab.url
    tab.goto("about:blank")
    tab.goto(address)
    tab.wait_for_selector("html[data-sample='mug-b']")
    assert tab.is_visible("#viewer")


def test_slices_and_depth_maps(tab: Tab, report_made: Any, read_page: Any) -> None:
    page, sample = read_page(report_made.page)
    arrays, _ = sample([row["key"] for row in page["samples"]].index("chair-a"))
    row, column, size = arrays["slice1/squares"].T
    [corner] = np.flatnonzero((row + size == 32) & (column == 0))
    width, value = arrays["slice1/squares"][corner, 2], arrays["slice1/values"][corner]
    assert width > 1
    open_sample(tab, "chair-a")
    assert tab.locator(".side figure canvas").count() == 2 and tab.locator(".side figure img").count() == 4
    assert widths(tab, ".side img") == [80] * 4
    tab.hover(".side canvas >> nth=1", position={"x": 4, "y": 4})
    assert tab.inner_text("#tip") == f"z 31, x 0: a cell of {width}³ voxels, {value / 127.5 - 1:.2f} τ"
    tab.click(".side canvas >> nth=1", position={"x": 30, "y": 30})
    assert tab.is_visible("#large canvas")
    tab.keyboard.press("Escape")
    assert tab.is_hidden("#large") and tab.is_visible("#viewer")


def test_a_page_with_a_folder_beside_it(shared_tab: tuple[Tab, list[str]], report_made: Any, tmp_path: Path,
                                        monkeypatch: pytest.MonkeyPatch) -> None:
    """The same to look at; and a sentence where the folder was left behind."""
    tab, wrong = shared_tab
    monkeypatch.setattr("ocnf_data.report.run.PageWriter", lambda path: PageWriter(path, largest=1))
    done = write_report(str(report_made.data), tmp_path / "a page.html", meshes=report_made.meshes, limit=2)
    assert [path.name for path in done.paths] == ["a page.html", "a page_files"]
    tab.goto(done.paths[0].as_uri())
    first = tab.locator(".card").first.get_attribute("data-key")
    open_sample(tab, first)
    assert silhouette(picture(tab)).mean() > 0.02 and tab.is_hidden("#message") and wrong == []
    shutil.rmtree(done.paths[1])
    tab.goto("about:blank")
    tab.goto(done.paths[0].as_uri())
    open_sample(tab, first)
    assert "a page_files belongs to this page" in tab.inner_text("#message")
    wrong.clear()  # Chromium says too that the file is not there


def test_without_webgl_the_rest_is_shown(browser: Browser, report_made: Any) -> None:
    tab = browser.new_page()
    tab.add_init_script("HTMLCanvasElement.prototype.getContext = (get => function (kind, ...more) {"
                        "return kind.startsWith('webgl') ? null : get.call(this, kind, ...more) })"
                        "(HTMLCanvasElement.prototype.getContext)")
    tab.goto(report_made.page.as_uri())
    open_sample(tab, "chair-a")
    assert "no WebGL" in tab.inner_text("#message")
    assert tab.locator(".side figure canvas").count() == 2
    tab.close()
