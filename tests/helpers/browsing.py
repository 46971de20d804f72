"""A real browser for the tests of the page: it must not complain, and must not fetch anything from elsewhere."""

import base64
import shutil
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import app_case
import pytest

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: no test in a real browser")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium on this machine: the page is not tried in a browser"
)

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]
SECOND = 1000
playwright.expect.set_options(timeout=120 * SECOND)  # a busy machine takes its time


def browsing(client, width=1280, height=720, **options):
    """The page of a server of the tests."""
    return at(f"http://{client.base_url.netloc.decode()}/?token={app_case.TOKEN}", width, height, **options)


@contextmanager
def at(address, width=1280, height=720, expected=None, **options):
    """A page let in by the address that the server prints; it ends without a word on the console or a foreign call.

    A word with `expected` in it is no complaint.
    """
    host = urlsplit(address).netloc
    complaints: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=FLAGS)
        # Without gliding views: what is to be pulled or clicked on the scene would move away.
        page = browser.new_page(viewport={"width": width, "height": height}, reduced_motion="reduce", **options)
        page.set_default_timeout(120 * SECOND)
        page.on("console", lambda message: complaints.append(f"{message.text} {message.location['url']}"))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        own = (f"http://{host}/", "data:", "blob:")
        page.on("request", lambda request: request.url.startswith(own) or complaints.append(request.url))
        page.goto(address)
        yield page
        browser.close()
    assert not [words for words in complaints if expected is None or expected not in words], complaints


def drop(page, path: Path):
    """Drop a file on the page as a hand does."""
    page.wait_for_selector(".drop")
    give = """([name, text]) => {
        const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
        const transfer = new DataTransfer();
        transfer.items.add(new File([bytes], name));
        return transfer;
    }"""
    transfer = page.evaluate_handle(give, [path.name, base64.b64encode(path.read_bytes()).decode()])
    page.dispatch_event(".drop", "drop", {"dataTransfer": transfer})


def step(page, title):
    page.locator(".stepper").get_by_role("button", name=title, exact=False).click()


def in_time(page, is_so, seconds=60):
    """Ask until it is so; a message on the page may be that of something else."""
    until = time.monotonic() + seconds
    while not (found := is_so()) and time.monotonic() < until:
        page.wait_for_timeout(100)
    return found
