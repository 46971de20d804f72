"""Films of the page: the frames of every flow, one frame while the arm is turned, and the curves."""

import json

import numpy as np
import pytest

from vstent.angiography.film import PAPER
from vstent.angiography.history import History
from vstent.angiography.view import angles_of
from vstent.app.films import films_message, kept_curves

LINE = np.arange(-2.75, 3, 0.5)
POINTS = np.stack(np.meshgrid(LINE, LINE, LINE, indexing="ij"), axis=-1).reshape(-1, 3)


def history(last: int) -> History:
    """Return contrast that fills a cube evenly from 0 to `last` of 255 in four steps."""
    stored = np.repeat(np.array([[0], [last // 3], [2 * last // 3], [last]], np.uint8), len(POINTS), axis=1)
    return History(POINTS, 0.5, np.arange(len(POINTS)), np.arange(4) / 7.5, stored, 300.0)


def opened(answer: bytes):
    length = int.from_bytes(answer[:4], "little")
    return json.loads(answer[4 : 4 + length]), answer[4 + length :]


def frames(told, data, k):
    block = told["panes"][k]["frames"]
    raw = np.frombuffer(data, np.uint8, count=block["length"], offset=block["offset"])
    return raw.reshape(-1, told["rows"], told["columns"])


def test_all_frames_of_all_flows_share_times_and_scale():
    both = {"bare": history(255), "silk": history(180)}
    told, data = opened(films_message(both, angles_of("AP"), stents={}, curves=[]))
    assert told["view"] == "LAO 0 CRA 0"
    assert [pane["id"] for pane in told["panes"]] == ["bare", "silk"]
    assert told["times_s"] == pytest.approx(np.arange(4) / 7.5, abs=1e-4)
    bare, silk = frames(told, data, 0), frames(told, data, 1)
    assert bare.shape == silk.shape == (4, told["rows"], told["columns"])
    middle = told["rows"] // 2, told["columns"] // 2
    assert bare[3][middle] == 0  # filled with the largest concentration, the longest ray is black
    level = 255 * PAPER * (1 - (180 / 255) ** 2)  # values are square roots of the concentration
    assert silk[3][middle] == pytest.approx(level, abs=2)
    assert bare[0][0, 0] == round(255 * PAPER)


def test_a_single_frame_is_that_of_the_film_with_coarser_pixels():
    whole, data = opened(films_message({"bare": history(255)}, angles_of("LAO 30"), stents={}))
    one, quick = opened(films_message({"bare": history(255)}, angles_of("LAO 30"), stents={}, moment=2))
    assert one["moment"] == 2
    assert frames(one, quick, 0).shape[0] == 1
    assert one["rows"] < whole["rows"]
    film, frame = frames(whole, data, 0)[2], frames(one, quick, 0)[0]
    assert frame[one["rows"] // 2, one["columns"] // 2] == pytest.approx(
        film[whole["rows"] // 2, whole["columns"] // 2], abs=6
    )


def test_curves_come_from_the_table_of_the_case(tmp_path):
    assert kept_curves(tmp_path) == []
    (tmp_path / "angiogram").mkdir()
    table = tmp_path / "angiogram" / "curves.csv"
    table.write_text(
        "flow,time_s,sac_iodine_mg_mL,parent_artery_iodine_mg_mL\nbare,0,0,10\nbare,1,20,30\nsilk,0,0,11\nsilk,1,5,31\n"
    )
    curves = kept_curves(tmp_path)
    assert [(one["name"], one["region"]) for one in curves] == [
        ("bare", "sac"),
        ("bare", "artery"),
        ("silk", "sac"),
        ("silk", "artery"),
    ]
    assert curves[2]["values"] == [0, 5]
    table.write_text("flow,time_s\nbare,none\n")
    assert kept_curves(tmp_path) == []
