"""The step Image in a real browser: linked slices, their tools, and the outlines of what was found."""

import re

import app_case
import numpy as np
import pytest
import report_case
from browsing import browsing, in_time, needs_browser, playwright, step

from vstent.app.cases import STEPS, Cases, dependencies
from vstent.geometry.image import Image
from vstent.io.archive import save_data
from vstent.study.folder import CACHE

pytestmark = needs_browser

CENTER_MM = np.array([10.0, -20.0, 30.0])
"""Middle of the scan of a ball, in LPS."""
OFFSET_MM = np.array([6.0, -4.0, 5.0])
"""The ball lies to the left, to the front and to the head of it."""
LOOKS = {"Sagittal": (1, 2, "APHF"), "Coronal": (0, 2, "RLHF"), "Axial": (0, 1, "RLAP")}
"""World axes to the right and downwards, and the letters at the left, right, top and bottom."""
SHAPE, SPACING_MM = (30, 50, 70), np.array([1.5, 0.8, 0.5])


def write_nifti(path, image):
    import SimpleITK

    found = SimpleITK.GetImageFromArray(image.voxels.T)
    found.SetSpacing(image.spacing_mm.tolist())
    found.SetOrigin(image.affine_mm[:3, 3].tolist())
    found.SetDirection((image.affine_mm[:3, :3] / image.spacing_mm).ravel().tolist())
    path.parent.mkdir(parents=True, exist_ok=True)
    SimpleITK.WriteImage(found, path)


def ball_scan():
    """A bright ball in a scan whose axes run to the feet, to the right and to the back."""
    affine = np.eye(4)
    affine[:3, :3] = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]).T * SPACING_MM
    affine[:3, 3] = CENTER_MM - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    image = Image(np.zeros(SHAPE, dtype=np.uint8), affine)
    places_mm = image.to_mm(np.moveaxis(np.indices(SHAPE), 0, -1).reshape(-1, 3))
    inside = np.linalg.norm(places_mm - CENTER_MM - OFFSET_MM, axis=-1) < 8.5
    return Image((200 * inside).astype(np.uint8).reshape(SHAPE), affine)


TURN_DEG = 16.0
"""Angle of the oblique scan against the patient."""


def about_x(degrees):
    """Rotation about the axis from the right to the left."""
    angle = np.radians(degrees)
    return np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])


SIZES = [(1920, 1080), (1366, 768), (1024, 768)]


def ball_case(workspace, name, turn=None):
    """A case of which only the scan is there; its axes may be turned about its middle."""
    case, image = Cases(workspace).create(name), ball_scan()
    if turn is not None:
        affine = image.affine_mm.copy()
        affine[:3, :3] = turn @ affine[:3, :3]
        affine[:3, 3] = CENTER_MM - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
        image = Image(image.voxels, affine)
    write_nifti(case.folder / "input" / "scan.nii.gz", image)
    case.update(input="input/scan.nii.gz", source="ball")


def analytic_case(workspace):
    """A case whose scan shows the analytic artery of the report's tests, its vessel found and Silk deployed."""
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 3] = [-14.0, -5.0, -4.0]
    image = Image(np.zeros((57, 21, 50), dtype=np.int16), affine)
    places_mm = image.to_mm(np.moveaxis(np.indices((57, 21, 50)), 0, -1).reshape(-1, 3))
    away_mm = np.abs(report_case.anatomy().vessel.lumen.closest(places_mm)[1])
    image = Image((1000 * np.exp(-away_mm)).astype(np.int16).reshape(57, 21, 50), affine)
    case = Cases(workspace).create("analytic")
    write_nifti(case.folder / "input" / "scan.nii.gz", image)
    (case.folder / CACHE).mkdir()
    save_data(case.folder / CACHE / "anatomy-known.npz", report_case.anatomy())
    state = case.update(input="input/scan.nii.gz", source="known", anatomy="known")
    case.update(done={name: dependencies(state)[name] for name in STEPS[:5]})
    return image


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return tmp_path_factory.mktemp("cases")


@pytest.fixture(scope="module")
def client(workspace):
    analytic_case(workspace)
    for width, _ in SIZES:
        ball_case(workspace, f"ball-{width}")
    ball_case(workspace, "turned", about_x(TURN_DEG))
    with app_case.served(workspace) as client:
        yield client


def reading(page):
    """Value, LPS and RAS under the pointer or at the cross-hair."""
    text = page.locator(".slice-reading").inner_text().replace("−", "-")
    value, lps, ras = re.match(r"\w+ ([-\d.–]+) · LPS ([^·]+) · RAS ([^·]+) mm · voxel", text).groups()
    return value, *(np.array([float(x) for x in part.split(",")]) for part in (lps, ras))


def laid(page):
    """Wait until the slices are drawn in their final size: the threshold, proposed later, takes room above them."""
    page.locator(".slice[data-bar]").nth(2).wait_for()
    page.locator(".slice-chip", has_text="Threshold").wait_for()
    page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")


def pane_of(page, title):
    return page.locator(f".slice:has-text('{title}')")


def pixels_per_mm(pane):
    mm, pixels = re.match(r"([\d.]+) mm ([\d.]+) px", pane.get_attribute("data-bar")).groups()
    return float(pixels) / float(mm)


def on_slice(pane, right_mm, down_mm):
    """Where on the page lies what is so far from the middle of the slice."""
    box, scale = pane.locator(".slice-area").bounding_box(), pixels_per_mm(pane)
    return box["x"] + box["width"] / 2 + right_mm * scale, box["y"] + box["height"] / 2 + down_mm * scale


def in_plane(title, offset_mm):
    """An offset in LPS as it is seen in a slice: to the right and down."""
    right, down, _ = LOOKS[title]
    return offset_mm[right], offset_mm[down] if down == 1 else -offset_mm[down]


MIDDLE_OF_WHITE = """(canvas) => {
    const { width, height } = canvas;
    const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(canvas, 0, 0);
    const { data } = copy.getImageData(0, 0, width, height);
    let [n, x, y] = [0, 0, 0];
    for (let i = 0; i < width * (height - 60); i++) { // without the bar of lengths below
        if (Math.min(...data.slice(4 * i, 4 * i + 3)) <= 200) continue;
        (n++, (x += i % width), (y += Math.floor(i / width)));
    }
    return n ? [(x / n + 0.5) / width - 0.5, (y / n + 0.5) / height - 0.5] : [null, null];
}"""
COUNT = """(canvas, [r, g, b]) => {
    const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(canvas, 0, 0);
    const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
    let n = 0;
    for (let i = 0; i < data.length; i += 4)
        n += Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 80;
    return n;
}"""


def case_of(client, name):
    (case,) = [case["id"] for case in client.get("/api/cases").json()["cases"] if case["name"] == name]
    return client.get(f"/api/cases/{case}").json()


def chosen(client, name):
    return case_of(client, name)["choices"]


@pytest.mark.parametrize(
    "size", [SIZES[1], *(pytest.param(size, marks=pytest.mark.validation) for size in (SIZES[0], SIZES[2]))], ids=str
)
def test_slices_are_linked_and_measure_in_mm(client, size):
    """Letters, cross-hair, value, position, ruler, seed and crop box of a scan stored along unusual axes."""
    name = f"ball-{size[0]}"
    with browsing(client, *size) as page:
        page.locator(".recent-case", has_text=name).click()
        laid(page)
        for title, (*_, letters) in LOOKS.items():
            pane = pane_of(page, title)
            playwright.expect(pane).to_be_visible()
            assert in_time(page, lambda: "".join(pane.locator(".slice-side").all_inner_texts()) == letters)  # noqa: B023
            # The row of tools breaks into two once the window's words are in it: the panes change their size.
            axial = pane_of(page, "Axial")
            assert in_time(page, lambda: pixels_per_mm(pane) == pytest.approx(pixels_per_mm(axial)))  # noqa: B023
        follow_the_cross_hair(page)
        measure(page)
        seed_and_crop(client, page, name)


def follow_the_cross_hair(page):
    """A click in one slice turns the other two to that point; keys move by one voxel."""
    axial = pane_of(page, "Axial")
    canvas = axial.locator("canvas")
    assert in_time(page, lambda: canvas.evaluate(MIDDLE_OF_WHITE)[0] is not None)  # the slice is drawn
    middle = canvas.evaluate(MIDDLE_OF_WHITE)
    page.mouse.click(*on_slice(axial, 6, -4.1))
    assert in_time(
        page, lambda: pane_of(page, "Sagittal").locator(".slice-label").inner_text().startswith("Sagittal 18 ")
    )
    assert pane_of(page, "Coronal").locator(".slice-label").inner_text().startswith("Coronal 27 ")
    # What is drawn lies where a click finds it: the axial slice through the middle shows the ball off its middle.
    box = axial.locator(".slice-area").bounding_box()
    scale = pixels_per_mm(axial)
    drawn_mm = middle[0] * box["width"] / scale, middle[1] * box["height"] / scale
    assert drawn_mm == pytest.approx((6, -4), abs=0.35)
    coronal = pane_of(page, "Coronal")
    page.mouse.click(*on_slice(coronal, 6, -5))
    assert in_time(page, lambda: reading(page)[0] == "200")
    _, lps, ras = reading(page)
    np.testing.assert_allclose(lps[[0, 2]], (CENTER_MM + OFFSET_MM)[[0, 2]], atol=0.15)
    np.testing.assert_allclose(lps, ras * [-1, -1, 1], atol=0.01)
    page.mouse.move(*on_slice(coronal, -12, 12))
    assert in_time(page, lambda: reading(page)[0] == "0")
    coronal.locator(".slice-area").focus()
    page.mouse.move(5, 5)
    page.wait_for_selector(".slice-reading[data-at=cross]")
    before = reading(page)[1]
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("PageUp")
    assert in_time(
        page, lambda: np.all(reading(page)[1][:2] != before[:2]) and abs(reading(page)[1][0] - before[0]) > 1
    )
    moved = np.abs(reading(page)[1] - before)
    assert moved[0] == pytest.approx(1.6, abs=0.4)  # from between two voxels
    assert moved[1] == pytest.approx(0.5, abs=0.1)
    page.mouse.move(*on_slice(axial, 0, 0))
    label = axial.locator(".slice-label").inner_text()
    page.mouse.wheel(0, 120)
    assert in_time(page, lambda: axial.locator(".slice-label").inner_text() != label)


def measure(page):
    """The ruler and the bar agree, whatever the zoom; window and level change and go back; a slab is a maximum."""
    axial = pane_of(page, "Axial")
    scale = pixels_per_mm(axial)
    page.get_by_role("button", name="Ruler").click()
    page.mouse.move(*on_slice(axial, -10, 0))
    page.mouse.down()
    page.mouse.move(*on_slice(axial, 2, 9), steps=3)
    page.mouse.up()
    playwright.expect(page.locator(".slice-extra")).to_contain_text("15.0 mm")
    page.get_by_role("button", name="Remove rulers").click()
    words = page.locator(".slice-window")
    before = words.inner_text()
    page.mouse.move(*on_slice(axial, 0, 0))
    page.mouse.down(button="right")
    page.mouse.move(*on_slice(axial, 8, 3), steps=3)
    page.mouse.up(button="right")
    playwright.expect(words).not_to_have_text(before)
    page.keyboard.down("Control")
    page.mouse.wheel(0, -400)
    page.keyboard.up("Control")
    assert in_time(page, lambda: pixels_per_mm(axial) > 1.3 * scale)
    page.locator(".slice-bar select").last.select_option(label="MIP 10 mm")
    playwright.expect(axial.locator(".slice-label")).to_contain_text("MIP 10 mm")
    page.get_by_role("button", name="Reset").click()
    playwright.expect(words).to_have_text(before)
    assert in_time(page, lambda: pixels_per_mm(axial) == pytest.approx(scale))


def seed_and_crop(client, page, name):
    page.get_by_role("button", name="Seed", exact=True).click()
    page.mouse.click(*on_slice(pane_of(page, "Coronal"), 6, -5))
    assert in_time(page, lambda: chosen(client, name)["at_mm"] is not None)
    np.testing.assert_allclose(
        np.array(chosen(client, name)["at_mm"])[[0, 2]], (CENTER_MM + OFFSET_MM)[[0, 2]], atol=0.2
    )
    coronal = pane_of(page, "Coronal").locator("canvas")
    assert in_time(page, lambda: coronal.evaluate(COUNT, [255, 225, 77]) > 20)  # the seed is drawn
    playwright.expect(page.locator(".seed-mark")).to_be_visible()
    page.get_by_role("button", name="Crop").click()
    pane = pane_of(page, "Axial")
    page.mouse.move(*on_slice(pane, -20, 2))
    page.mouse.down()
    page.mouse.move(*on_slice(pane, -10, 2), steps=4)
    # The box stays in hand when another window takes the seed away.
    case = case_of(client, name)
    changed = {"revision": case["revision"], "choices": case["choices"] | {"at_mm": None}}
    client.put(f"/api/cases/{case['id']}/choices", json=changed).raise_for_status()
    playwright.expect(page.locator(".seed-mark")).to_be_hidden()
    page.mouse.up()
    assert in_time(page, lambda: chosen(client, name)["crop_mm"] is not None)
    lowest_mm = np.min(chosen(client, name)["crop_mm"], axis=0)
    assert lowest_mm[0] == pytest.approx(CENTER_MM[0] - 10, abs=0.8)
    page.get_by_role("button", name="Whole scan").click()
    assert in_time(page, lambda: chosen(client, name)["crop_mm"] is None)
    page.get_by_role("button", name="Cross-hair").click()


def seen(page, canvas, colour, is_right):
    """Return the number of pixels of a colour once it is right."""
    assert in_time(page, lambda: is_right(canvas.evaluate(COUNT, colour)))
    return canvas.evaluate(COUNT, colour)


def test_outlines_of_all_that_was_found_lie_on_the_slices(client):
    """Each outline is drawn and can be switched off; a click in 3-D turns the slices; one slice fills the room."""
    with browsing(client) as page:
        page.locator(".recent-case", has_text="analytic").click()
        page.locator(".sheet .row").first.wait_for()  # the slices turn to the neck as soon as it is known
        step(page, "Image")
        page.wait_for_selector("[data-outlines*=wires]")
        chips = ["Threshold", "Lumen", "Parent artery", "Sac", "Neck", "Device"]
        playwright.expect(page.locator(".slice-chip")).to_have_text(chips)
        laid(page)
        page.locator(".slice-chip", has_text="Device").click()
        coronal = pane_of(page, "Coronal").locator("canvas")
        for chip, colour in (("Lumen", [76, 201, 240]), ("Sac", [255, 107, 107]), ("Neck", [241, 91, 181])):
            shown = seen(page, coronal, colour, lambda count: count > 30)
            button = page.locator(".slice-chip", has_text=chip)
            button.click()
            seen(page, coronal, colour, lambda count, shown=shown: count < 0.7 * shown)
            button.click()
            seen(page, coronal, colour, lambda count, shown=shown: count == shown)
        label = pane_of(page, "Coronal").locator(".slice-label")
        before = label.inner_text()
        page.locator(".viewer-length").wait_for()  # the surface is drawn
        box = page.locator(".viewer-area").bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert in_time(page, lambda: label.inner_text() != before)
        pane_of(page, "Coronal").get_by_role("button").click()
        playwright.expect(pane_of(page, "Axial")).to_be_hidden()
        pane_of(page, "Coronal").get_by_role("button").click()
        playwright.expect(pane_of(page, "Axial")).to_be_visible()


def test_an_oblique_scan_is_shown_along_the_patient_or_along_its_file(client):
    """Anatomical planes move along the patient's axes; the slices of the file say by how much they are turned."""
    with browsing(client, 1024, 768) as page:
        page.route("**/image/surface?*", lambda _: None)  # it takes as long as it likes
        page.locator(".recent-case", has_text="turned").click()
        laid(page)
        playwright.expect(page.locator(".viewer-length")).to_be_hidden()  # nothing is seen that it could measure
        along = page.get_by_label("Direction of the slices")
        assert along.input_value() == "patient"
        labels = [words.split(" ")[0] for words in page.locator(".slice-label").all_inner_texts()]
        assert sorted(labels) == ["Axial", "Coronal", "Sagittal"]
        assert page.get_by_role("button", name="Crop").is_disabled()
        axial = pane_of(page, "Axial")
        moved_mm = moved(page, axial)
        np.testing.assert_allclose(moved_mm, [0, 5, 0], atol=0.35)
        ball_mm = CENTER_MM + about_x(TURN_DEG) @ OFFSET_MM
        page.mouse.click(*on_slice(pane_of(page, "Coronal"), *in_plane("Coronal", ball_mm - CENTER_MM)))
        # The ball is round in a true axial plane, and its middle is where the patient has it.
        assert in_time(page, lambda: abs(middle_mm(axial)[1] - (ball_mm - CENTER_MM)[1]) < 0.6)
        page.mouse.move(1, 1)  # under a pointer the slices that are laid anew show another place
        before = reading(page)[1]
        along.select_option("file")
        playwright.expect(page.locator(".slice-label", has_text="Oblique to axial by 16°")).to_be_visible()
        assert page.locator(".slice-label", has_text="Sagittal").count() == 1  # the axis about which it is turned
        np.testing.assert_allclose(reading(page)[1], before, atol=0.06)
        oblique, wanted_mm = pane_of(page, "Oblique to axial"), about_x(TURN_DEG) @ [0, 5, 0]
        # The first movements may fall before the slices are laid anew.
        assert in_time(page, lambda: np.allclose(moved(page, oblique), wanted_mm, rtol=0, atol=0.35))
        assert page.get_by_role("button", name="Crop").is_enabled()


def middle_mm(pane):
    """Middle of what is bright on a slice, from the middle of the slice: to the right and down."""
    box, scale = pane.locator(".slice-area").bounding_box(), pixels_per_mm(pane)
    x, y = pane.locator("canvas").evaluate(MIDDLE_OF_WHITE)
    return [x * box["width"] / scale, y * box["height"] / scale] if x is not None else [np.inf, np.inf]


def moved(page, pane):
    """Change of the position in LPS mm over 5 mm downwards on a slice."""
    page.mouse.move(*on_slice(pane, 1, -2))
    before = reading(page)[1]
    page.mouse.move(*on_slice(pane, 1, 3))
    return reading(page)[1] - before
