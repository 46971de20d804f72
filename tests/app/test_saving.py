"""Pictures for a paper: any view as PNG and as SVG, of the same size and alike."""

import base64
import io
import re
from xml.etree import ElementTree

import app_case
import numpy as np
import pytest
from browsing import SECOND, browsing, in_time, needs_browser, playwright, step
from test_image_step import analytic_case, laid

from vstent.angiography.view import axes_of

pytestmark = needs_browser
SVG = "{http://www.w3.org/2000/svg}"
WIDTH_MM, DPI = 90, 150
WIDTH_PX = round(WIDTH_MM / 25.4 * DPI)


def saved(page, name, kind):
    """Bytes of a view as the page saves it, 90 mm wide at 150 dpi."""
    page.locator(f".save[aria-label$=': {name}']").click()
    form = page.locator(".save-form")
    form.locator("[data-key=format]").select_option(kind)
    form.locator("[data-key=dpi]").select_option(str(DPI))
    form.locator("input").fill(str(WIDTH_MM))
    with page.expect_download() as waited:
        form.get_by_role("button", name="Save", exact=True).click()
    assert waited.value.suggested_filename == f"vstent {name}.{kind.lower()}"
    return waited.value.path().read_bytes()


def pixels(png):
    """Intensities (rows, columns, 3) of a PNG and its resolution in dots per inch."""
    from PIL import Image

    image = Image.open(io.BytesIO(png))
    return np.asarray(image.convert("RGB")).astype(float), image.info.get("dpi", (0, 0))[0]


def drawn(page, svg, wide):
    """What a browser draws of an SVG file, so many pixels wide."""
    other = page.context.browser.new_page()
    source = f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"
    other.set_content(f"<body style='margin:0'><img style='width:{wide}px' src='{source}'></body>")
    other.wait_for_function("document.images[0].complete && document.images[0].naturalWidth")
    found = pixels(other.locator("img").screenshot())[0]
    other.close()
    return found


def words(root):
    return [text.text for text in root.iter(f"{SVG}text")]


def width_mm(root):
    return float(re.fullmatch(r"([\d.]+)mm", root.get("width")).group(1))


def alike(page, name):
    """The SVG file of a view; the PNG has its size and shows the same."""
    svg = saved(page, name, "SVG")
    png, dpi = pixels(saved(page, name, "PNG"))
    root = ElementTree.fromstring(svg)
    assert width_mm(root) == WIDTH_MM
    assert (png.shape[1], round(dpi)) == (WIDTH_PX, DPI)
    shown = drawn(page, svg, WIDTH_PX)[: len(png)]
    assert abs(len(shown) - len(png)) <= 1
    away = np.abs(shown - png[: len(shown)]).mean(axis=2)
    assert (away > 60).mean() < 0.01, name  # edges of letters differ by a fraction of a pixel
    assert png.reshape(-1, 3).std(axis=0).max() > 5
    return root


@pytest.fixture
def client(tmp_path):
    analytic_case(tmp_path)
    with app_case.served(tmp_path) as client:
        yield client


@pytest.mark.system
def test_any_view_is_saved_as_png_and_as_svg(client):
    with browsing(client, 1366, 768) as page:
        page.locator(".recent-case").click()
        slices_are_saved(page)
        step(page, "Deploy")
        playwright.expect(page.locator(".handle.distal .handle-word")).to_contain_text("mm", timeout=120 * SECOND)
        views_are_kept_and_turned_by_angles(client, page)
        ranges_are_chosen(client, page)
        before = page.locator(".viewer-area").bounding_box()
        scene_is_saved(page)
        assert page.locator(".viewer-area").bounding_box() == before
        charts_are_saved(page)


def slices_are_saved(page):
    page.locator(".sheet .row").first.wait_for()  # the slices turn to the neck as soon as it is known
    step(page, "Image")
    page.locator(".slice[data-outlines*=lumen]").nth(2).wait_for()
    laid(page)
    root = alike(page, "slices")
    assert len(list(root.iter(f"{SVG}image"))) == 3
    assert {"A", "P", "R", "L", "H", "F"} < set(words(root))
    assert sum(word.endswith(" mm") for word in words(root)) == 3


def scene_is_saved(page):
    """The scene is a raster; its length bar, its letters and its color bar are vectors."""
    root = alike(page, "3-D view")
    assert len(list(root.iter(f"{SVG}image"))) == 1
    assert {"L", "P", "S"} < set(words(root))
    assert "Gap between device and wall" in words(root)
    stops = list(root.iter(f"{SVG}stop"))
    assert len({stop.get("stop-color") for stop in stops}) == len(stops) == 17
    (length,) = [word for word in words(root) if re.fullmatch(r"[\d.]+ mm", word)]
    bars = [r for r in root.iter(f"{SVG}rect") if float(r.get("height")) == 2 and r.get("fill") == "rgb(22,38,46)"]
    shown = page.locator(".viewer-length")
    assert length.endswith("mm")
    assert shown.count() == len(bars) == 1
    # The view fits the height at every size, so the bar has its share of it.
    (image,) = root.iter(f"{SVG}image")
    share = float(bars[0].get("width")) / float(length.split()[0]) / float(image.get("height"))
    on_page = shown.bounding_box()["width"] / float(shown.inner_text().split()[0])
    assert share == pytest.approx(on_page / page.locator(".viewer-area").bounding_box()["height"], rel=0.005)


def arm(page):
    """The C-arm angles that the page states, in degrees: positive LAO and CRA."""
    side, primary, tilt, secondary = page.locator(".carm").input_value().split()
    return np.array([int(primary) * (-1 if side == "RAO" else 1), int(secondary) * (-1 if tilt == "CAU" else 1)])


TURNED_IN_FLIGHT = """() => {
    document.querySelector(".carm").dispatchEvent(new Event("change"));
    document.querySelector(".viewer-area").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
}"""
"""Begins to glide to the angles that are typed, and turns 0.12 rad further about the picture's upward direction."""


def turn_arm(page, words, shown):
    """Type angles, and wait until the view has glided there."""
    page.fill(".carm", words)
    page.keyboard.press("Enter")
    playwright.expect(page.locator(".carm")).to_have_value(shown)


def views_are_kept_and_turned_by_angles(client, page):
    """Angles are those of the films; a view that is saved comes back, after a reload as well."""
    page.emulate_media(reduced_motion="no-preference")
    page.get_by_role("button", name="Left", exact=True).click()
    playwright.expect(page.locator(".carm")).to_have_value("LAO 90 CRA 0")
    page.fill(".carm", "RAO 20, CAU 15")
    page.evaluate(TURNED_IN_FLIGHT)
    right, _, toward = axes_of(*np.radians([-20, -15]))
    x, y, z = np.cos(0.12) * toward - np.sin(0.12) * right
    wanted = np.degrees([np.arctan2(x, -y), np.arcsin(z)])
    playwright.expect(page.locator(".carm")).not_to_have_value("RAO 20, CAU 15")
    assert in_time(page, lambda: np.allclose(arm(page), wanted, rtol=0, atol=0.51))
    turned = page.locator(".carm").input_value()
    page.get_by_role("button", name="Save this view").click()
    page.fill("#ask-field", "Working")
    page.get_by_role("button", name="Save view").click()
    page.get_by_role("button", name="Working", exact=True).wait_for()
    turn_arm(page, "AP", "LAO 0 CRA 0")
    (view,) = client.get("/api/cases/analytic").json()["choices"]["views"]
    np.testing.assert_allclose(np.reshape(view["axes"], (3, 3))[2], [x, y, z], atol=1e-6)
    page.reload()
    page.get_by_role("button", name="Working", exact=True).click()
    playwright.expect(page.locator(".carm")).to_have_value(turned)
    page.get_by_role("button", name="Forget the view Working").click()
    playwright.expect(page.get_by_role("button", name="Working", exact=True)).to_have_count(0)
    page.fill(".carm", "up")
    page.keyboard.press("Enter")
    playwright.expect(page.locator(".toast.problem")).to_contain_text("is not a C-arm direction")
    page.emulate_media(reduced_motion="reduce")
    page.get_by_role("button", name="Profile", exact=True).click()


def ranges_are_chosen(client, page):
    """A range of one's own is on the bar and in the colors, after a reload as well; the computed one comes back."""
    ticks = page.locator(".picture-bars .viewer-ticks span")
    playwright.expect(ticks.last).to_be_visible()
    computed = ticks.all_inner_texts()
    before = pixels(page.screenshot())[0]
    page.get_by_role("button", name="Range of Gap between device and wall").click()
    page.locator(".save-form input").nth(0).fill("-1")
    page.locator(".save-form input").nth(1).fill("1")
    page.get_by_role("button", name="Use", exact=True).click()
    playwright.expect(ticks.last).to_have_text("1")
    playwright.expect(ticks.first).to_have_text("−1")
    assert in_time(page, lambda: np.abs(pixels(page.screenshot())[0] - before).max() > 40)
    kept = {"scale": "wall_gap", "low": -1.0, "high": 1.0}
    assert in_time(page, lambda: client.get("/api/cases/analytic").json()["choices"]["ranges"] == [kept])
    page.reload()
    playwright.expect(ticks.last).to_have_text("1")
    playwright.expect(ticks.first).to_have_text("−1")
    playwright.expect(page.locator(".link.range")).to_have_text("range (own)")
    page.get_by_role("button", name="Range of Gap between device and wall").click()
    page.get_by_role("button", name="As computed").click()
    page.get_by_role("button", name="Use", exact=True).click()
    playwright.expect(ticks.last).to_have_text(computed[-1])
    assert in_time(page, lambda: client.get("/api/cases/analytic").json()["choices"]["ranges"] == [])


def charts_are_saved(page):
    """Diagrams are vectors throughout."""
    root = alike(page, "diameter along the artery")
    assert not list(root.iter(f"{SVG}image"))
    assert {"neck", "Diameter, mm"} < set(words(root))
    lines = [path for path in root.iter(f"{SVG}path") if path.get("stroke") == "rgb(11, 100, 115)"]
    assert {path.get("fill") for path in lines} == {"none"}
    root = alike(page, "section")
    assert not list(root.iter(f"{SVG}image"))
    assert {"From the neck", "Artery"} < set(words(root))
