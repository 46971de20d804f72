"""The report in a real browser, where there is one: the scene is drawn, nothing complains, nothing is fetched."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import report_case

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")

QUIET = ("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--enable-logging=stderr",
         "--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=3000")  # fmt: skip
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def browse(folder, *options):
    page = folder / "report.html"
    page.write_text(report_case.html(), encoding="utf-8")
    command = [BROWSER, *QUIET, f"--user-data-dir={folder / 'profile'}", *options, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout, console


def test_scene_is_drawn_without_a_word_on_the_console(tmp_path):
    from matplotlib.image import imread

    shot = tmp_path / "page.png"
    _, console = browse(tmp_path, *SOFTWARE, "--window-size=1280,1500", f"--screenshot={shot}")
    assert console == []
    image = imread(shot)[..., :3]
    # The paper behind the three panes, and enough that is not paper in each of them.
    is_paper = np.abs(image - np.array([0xF6, 0xF8, 0xF9]) / 255).max(axis=2) < 0.002
    rows = np.flatnonzero(is_paper[:, 200:900].mean(axis=1) > 0.3)
    top, bottom = rows.min() + 70, rows.max() - 60
    assert bottom - top > 250
    for left, right in ((40, 340), (380, 680), (710, 1010)):
        drawn = ~is_paper[top:bottom, left:right]
        assert 0.15 < drawn.mean() < 0.95


def test_page_has_its_switches_and_asks_no_host(tmp_path):
    log = tmp_path / "net.json"
    dom, console = browse(tmp_path, *SOFTWARE, "--window-size=1280,720", f"--log-net-log={log}", "--dump-dom")
    assert console == []
    assert dom.count('class="viewer-pane"') == 3
    assert re.findall(r'aria-pressed="true">([^<]+)<', dom) == ["Wires"]
    assert len(re.findall(r'<input type="checkbox">', dom)) == 12
    urls = set(re.findall(r'"url":"((?:https?|wss?):[^"]+)"', log.read_text(errors="replace")))
    assert {url for url in urls if "google" not in url} == set()  # the browser's own calls home fail and do not count
    assert json.dumps("report.html")[1:-1] in dom or "vstent report" in dom


def test_without_webgl_the_page_says_so_and_keeps_its_pictures(tmp_path):
    dom, _ = browse(tmp_path, "--disable-3d-apis", "--disable-gpu", "--window-size=1280,720", "--dump-dom")
    assert "needs WebGL" in dom
    assert "<canvas" not in dom
    assert dom.count("<img ") == sum(map(len, (report_case.contents().pictures, report_case.contents().of_method)))
