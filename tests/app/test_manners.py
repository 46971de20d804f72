"""How the page behaves: history, keys, definitions, cases, layouts, and what a reader with a screen reader meets."""

import re
from pathlib import Path

import app_case
import pytest
import report_case
from browsing import BROWSER, FLAGS, browsing, in_time, needs_browser, playwright, step
from test_image_step import analytic_case

from vstent.app.cases import Cases
from vstent.errors import InputError

pytestmark = needs_browser

AXE = Path(__file__).parents[2] / "viewer" / "node_modules" / "axe-core" / "axe.min.js"
"""Checker of accessibility; `npm ci` in viewer/ brings it."""
STEPS = ("Image", "Vessel", "Sac and parent", "Treatment", "Deploy", "Flow", "Report")


@pytest.fixture
def workspace(tmp_path):
    analytic_case(tmp_path)
    return tmp_path


@pytest.fixture
def client(workspace):
    with app_case.served(workspace) as client:
        yield client


def open_case(page, name="analytic"):
    page.locator(".recent-case", has_text=name).click()
    page.wait_for_selector(".step")


def heading(page, title):
    playwright.expect(page.locator(".panel h2").first).to_have_text(title)


@pytest.mark.system
def test_the_page_keeps_its_manners(client):
    """Back, names of outlets, proposed values, definitions, the list of cases, and a new key, in one visit."""
    with browsing(client, 1024, 768, expected="401") as page:
        open_case(page)
        for title in ("Vessel", "Sac and parent"):
            step(page, title)
            heading(page, title)
        playwright.expect(page.locator(".opening b", has_text="Outlet 1")).to_be_visible()
        assert page.locator("#field-outlet option").first.inner_text() == "outlet 1 (proposed)"
        page.go_back()
        heading(page, "Vessel")
        definitions_are_shown(client, page)
        step(page, "Flow")
        # The inflow that is proposed: 0.27 m/s through an inlet of 2 mm radius.
        playwright.expect(page.locator("#field-inflow")).to_have_attribute("placeholder", re.compile(r"\d"))
        assert float(page.get_attribute("#field-inflow", "placeholder")) == pytest.approx(0.27 * 12.566, abs=0.01)
        assert 0.05 < float(page.get_attribute("#field-cell", "placeholder")) < 0.4
        find_again_where_it_is_offered(client, page)
        a_new_key_opens_the_page_where_it_was(client, page)
        cases_are_renamed_and_deleted(client, page)


def definitions_are_shown(client, page):
    """By keys and by touch, and read as a description; a redraw takes neither the definition nor the focus away."""
    page.locator(".sheet .term.defined").first.wait_for()
    tip = page.locator(".tip")
    page.keyboard.press("Tab")  # from here on the focus is seen
    name = page.evaluate("""() => {
        const term = document.querySelector(".sheet .term.defined");
        term.focus();
        return term.textContent;
    }""")
    described = page.locator(".term:focus")
    playwright.expect(described).to_have_text(name)
    playwright.expect(described).to_have_attribute("aria-describedby", "tip")
    # Bringing a term into view scrolls, and moves other things below the pointer; its definition stays.
    assert (
        page.evaluate("""() => {
        const term = document.activeElement;
        term.parentElement.dispatchEvent(new Event("scroll", { bubbles: true }));
        document.body.dispatchEvent(new PointerEvent("pointerover", { bubbles: true }));
        return term.getAttribute("aria-describedby");
    }""")
        == "tip"
    )
    page.evaluate(WATCHED)
    meaning = tip.inner_text()
    assert len(meaning) > 20
    redrawn(client, page)
    playwright.expect(described).to_have_text(name)
    playwright.expect(described).to_have_attribute("aria-describedby", "tip")
    assert set(page.evaluate("shown")) == {meaning}
    page.keyboard.press("Escape")
    playwright.expect(tip).to_be_hidden()
    for place in (".step[data-key=vessel]", ".panel .next", ".picture-tools .chip.view >> nth=0"):
        words = page.locator(place).inner_text()
        page.locator(place).focus()
        redrawn(client, page)
        playwright.expect(page.locator(":focus")).to_have_text(words, use_inner_text=True)
    page.keyboard.press("Escape")
    # As a touch does: a pointer that rests shows the definition by itself, and its click takes that away.
    page.locator(".sheet .term.defined").first.dispatch_event("click")
    playwright.expect(tip).to_be_visible()
    page.keyboard.press("Escape")


WATCHED = """() => {
    window.shown = [];
    const look = () => {
        shown.push(document.querySelector(".tip:not([hidden])")?.textContent);
        requestAnimationFrame(look);
    };
    look();
}"""
"""Notes the definition that every frame shows."""


def redrawn(client, page):
    """Draw every part anew, by a view that another window saves."""
    page.evaluate("document.querySelector('.numbers').firstChild.isOld = true")
    case = analytic(client)
    views = case["choices"]["views"]
    view = {
        "name": f"Another {len(views)}",
        "axes": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "center_mm": [0, 0, 0],
        "distance_mm": 9,
    }
    choices = {**case["choices"], "views": [*views, view]}
    client.put(
        "/api/cases/analytic/choices", json={"revision": case["revision"], "choices": choices}
    ).raise_for_status()
    page.locator(".kept-view", has_text=view["name"]).wait_for(state="attached")
    assert page.evaluate("!document.querySelector('.numbers').firstChild.isOld")


def find_again_where_it_is_offered(client, page):
    step(page, "Vessel")
    page.fill("#field-upstream_mm", "12")
    page.keyboard.press("Tab")
    page.wait_for_selector(".step.stale:nth-child(2)")
    step(page, "Treatment")

    def overtaken(route):
        """The answer comes when the job that it tells of is cancelled."""
        answer = route.fetch()
        playwright.expect(page.locator(".work")).to_be_visible()
        client.delete("/api/cases/analytic/jobs")
        playwright.expect(page.locator(".work")).to_be_hidden()
        route.fulfill(response=answer)

    page.route("**/jobs/anatomy", overtaken)
    with page.expect_response("**/jobs/anatomy"):
        page.get_by_role("button", name="Find it again").click()
    page.unroute("**/jobs/anatomy")
    page.wait_for_timeout(300)
    heading(page, "Treatment")


def a_new_key_opens_the_page_where_it_was(client, page):
    """A server that was started again has another key: the page explains it, open or loaded anew."""
    playwright.expect(page.locator(".work")).to_be_hidden()
    page.context.clear_cookies()
    # Not by the pointer: a request that was under way may have opened the dialog over the steps by now.
    page.locator(".stepper").get_by_role("button", name="Deploy").dispatch_event("click")
    playwright.expect(page.locator("dialog")).to_contain_text("The server has a new key")
    page.fill("#ask-field", f"http://localhost/?token={app_case.TOKEN}")
    with page.expect_event("load"):
        page.get_by_role("button", name="Open the page").click()
    heading(page, "Deploy")
    page.context.clear_cookies()
    page.goto(f"http://{client.base_url.netloc.decode()}/")
    playwright.expect(page.locator("main")).to_contain_text("Your cases are kept.")
    playwright.expect(page.locator("#token")).to_be_focused()
    page.fill("#token", app_case.TOKEN)
    page.get_by_role("button", name="Open the page").click()


@pytest.mark.system
def test_what_is_done_while_the_page_is_redrawn_is_not_lost(client):
    """A click, a text that is no number yet, and a device looked for by keys."""
    with browsing(client, 1024, 768) as page:
        open_case(page)
        page.locator(".sheet .row").first.wait_for()
        for place, title in (
            (".step[data-key=vessel]", "Vessel"),
            (".panel .next", "Sac and parent"),
            (".panel .next", "Treatment"),
        ):
            press(page, place, lambda: redrawn(client, page))
            heading(page, title)
        playwright.expect(page.locator(".chosen b")).to_have_text(["Silk", "Enterprise"])
        press(page, ".chosen label.device >> nth=1", lambda: redrawn(client, page))
        assert in_time(page, lambda: [one["name"] for one in analytic(client)["choices"]["treatments"]] == ["silk"])
        page.get_by_label("Add a device to Silk").focus()
        page.keyboard.type("enter")
        redrawn(client, page)
        page.keyboard.press("Enter")
        playwright.expect(page.locator(".implant > span")).to_have_text(["1. Silk proposed", "2. Enterprise proposed"])
        step(page, "Flow")
        field = page.locator("#field-inflow")
        field.press_sequentially("3.")
        redrawn(client, page)
        page.keyboard.type("2")
        redrawn(client, page)
        page.keyboard.press("Home")
        page.keyboard.press("ArrowRight")
        redrawn(client, page)
        page.keyboard.type("1")
        playwright.expect(field).to_have_value("31.2")
        redrawn(client, page)
        page.keyboard.press("Tab")
        assert in_time(page, lambda: analytic(client)["choices"]["flow"]["inflow_mL_s"] == 31.2)


def analytic(client):
    return client.get("/api/cases/analytic").json()


def press(page, place, meanwhile):
    """Click where something else happens between press and release."""
    page.locator(place).scroll_into_view_if_needed()
    box = page.locator(place).bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    meanwhile()
    page.mouse.up()


def cases_are_renamed_and_deleted(client, page):
    card = page.locator(".recent-card")
    # A search that was stopped leaves the earlier results.
    playwright.expect(card.locator("span")).to_contain_text(re.compile(r"[0-4] of 7 steps done, [1-5] out of date ·"))
    assert re.search(r"20\d\d", card.locator("span").inner_text())
    page.get_by_role("button", name="Rename analytic").click()
    page.fill("#ask-field", "Left carotid")
    page.get_by_role("button", name="Rename", exact=True).click()
    playwright.expect(card.locator("b")).to_have_text("Left carotid")
    page.get_by_role("button", name="Delete Left carotid").click()
    page.get_by_role("button", name="Cancel").click()
    assert [case["name"] for case in client.get("/api/cases").json()["cases"]] == ["Left carotid"]
    page.get_by_role("button", name="Delete Left carotid").click()
    page.get_by_role("button", name="Delete", exact=True).click()
    playwright.expect(card).to_have_count(0)
    assert client.get("/api/cases").json()["cases"] == []


def test_only_a_case_of_the_workspace_is_deleted(client, workspace, tmp_path_factory):
    """A folder given at the command line is left alone; the picture of a case is a PNG file."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    analytic_case(elsewhere)
    case = Cases(workspace).adopt(elsewhere / "analytic")
    with pytest.raises(InputError, match="Delete it there"):
        Cases(workspace).remove(case)
    assert (elsewhere / "analytic").is_dir()
    assert client.get("/api/cases/analytic/picture").status_code == 404
    assert client.put("/api/cases/analytic/picture", content=b"GIF89a").status_code == 422
    png = b"\x89PNG\r\n\x1a\n" + bytes(20)
    assert client.put("/api/cases/analytic/picture", content=png).json() == {"kept": True}
    assert client.get("/api/cases/analytic/picture").content == png
    assert client.delete("/api/cases/analytic").json() == {"cases": []}
    assert not (workspace / "analytic").exists()


SIZES = [
    (1024, 768),
    *(
        pytest.param(size, marks=pytest.mark.validation)
        for size in [(1920, 1080), (1366, 768), (768, 1024), (720, 450)]
    ),
]
OUTSIDE = """() => {
    const [w, h] = [innerWidth, innerHeight];
    const box = (name) => document.querySelector(name).getBoundingClientRect();
    const found = [];
    if (document.documentElement.scrollWidth > w) found.push("the page is wider than the window");
    if (box(".stepper").right > box("button[aria-label=Undo]").left + 1) found.push("the steps lie under the buttons");
    for (const name of ["header", ".left", "div.middle", ".panel"]) {
        const { left, right, top } = box(name);
        // A low window is scrolled: there the picture comes first.
        if (left < -1 || right > w + 1 || (top > h && document.documentElement.scrollHeight <= h)) found.push(name);
    }
    const { width, height } = box("div.middle");
    if (width * height < 0.38 * w * h) found.push(`the picture has ${Math.round((100 * width * height) / w / h)} %`);
    return found;
}"""
"""What does not fit into the window."""


@pytest.mark.validation
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_every_step_fits_and_is_accessible(client, size):
    """No part lies outside the window or under another, and axe has no serious finding."""
    with browsing(client, *size, bypass_csp=True) as page:
        open_case(page)
        for title in STEPS:
            step(page, title)
            page.wait_for_timeout(1500)
            assert page.evaluate(OUTSIDE) == [], title
            assert re.findall(r"outlet_\d|zero_pressure|\(--|\bTrue\b|\s-\d", page.inner_text("#app")) == [], title
            assert serious(page) == [], title
        page.locator(".brand").click()
        page.wait_for_selector(".recent-card")
        assert serious(page) == []
    if not AXE.is_file():
        pytest.skip("everything fits, but axe-core, which checks accessibility, is not installed (npm ci in viewer/)")


def serious(page):
    """Serious findings of axe; none without it."""
    if not AXE.is_file():
        return []
    page.evaluate("(source) => window.axe || (0, eval)(source)", AXE.read_text(encoding="utf-8"))
    violations = page.evaluate("async () => (await axe.run()).violations.map(({ impact, id }) => [impact, id])")
    return [found for found in violations if found[0] in ("serious", "critical")]


CUT = """() => [...document.querySelectorAll("body *")].filter((element) => {
    const box = element.getBoundingClientRect();
    const isFilled = element.scrollWidth > element.clientWidth + 1;
    const isClipped = getComputedStyle(element).overflowX !== "visible";
    return box.width && (box.right > innerWidth + 1 || (isFilled && isClipped));
}).map(({ tagName, className }) => `${tagName} ${className}`)"""


@pytest.mark.validation
def test_a_printed_report_is_not_cut(tmp_path):
    """On paper nothing is wider than the page, and what is folded is open."""
    path = tmp_path / "report.html"
    path.write_text(report_case.html(), encoding="utf-8")
    with playwright.sync_playwright() as driver:
        page = driver.chromium.launch(executable_path=BROWSER, args=FLAGS).new_page(
            viewport={"width": 703, "height": 990}
        )
        page.goto(path.as_uri())
        page.emulate_media(media="print")
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        assert page.locator("details:not([open])").count() == 0
        assert page.evaluate(CUT) == []
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        assert page.locator("details[open]").count() == 0


def test_a_dropped_surface_is_seen_before_its_vessel_is_found(client, tmp_path):
    """The surface as read is there at once, in the frame and unit of the vessel that follows."""
    from vstent.io.writers import write_stl

    path = tmp_path / "phantom.stl"
    write_stl(path, app_case.phantom_surface())
    case = client.post("/api/cases", json={"name": "surface"}).json()["id"]
    client.put(f"/api/cases/{case}/input", params={"name": path.name}, content=path.read_bytes())
    client.post(f"/api/cases/{case}/input/done")
    manifest, data = app_case.opened(client.get(f"/api/cases/{case}/input/surface"))
    client.delete(f"/api/cases/{case}/jobs")
    points_mm = app_case.numbers(manifest["layers"][0]["points"], data)
    wanted_mm = app_case.phantom_surface().vertices_mm
    assert points_mm.min(axis=0) == pytest.approx(wanted_mm.min(axis=0), abs=0.05)
    assert points_mm.max(axis=0) == pytest.approx(wanted_mm.max(axis=0), abs=0.05)
    assert client.get("/api/cases/analytic/input/surface").status_code == 422
