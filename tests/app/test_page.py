"""The page's server: the same numbers by every way in, choices that keep their order, cases that outlive the server."""

import hashlib
import json
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, replace
from importlib.resources import files
from pathlib import Path
from typing import get_args

import app_case
import numpy as np
import pytest
import report_case
from forks import PHANTOM

import vstent
from vstent import phantoms
from vstent.angiography.angiogram import AngiogramSettings
from vstent.angiography.history import History
from vstent.app import cuts, intake, ranking, sheets
from vstent.app.cases import STEPS, Cases, load
from vstent.app.finished import kept_flows, shown_flows
from vstent.app.workspace import Workspace
from vstent.cli import main
from vstent.deployment.deploy import deploy, propose_landing
from vstent.deployment.measure import measure
from vstent.devices.catalogue import find_design
from vstent.devices.stent import Coils, Deployment, Landing
from vstent.devices.treatment import read_treatment, with_device
from vstent.errors import ReadError
from vstent.fields import stated
from vstent.flow.case import FlowField, Phase
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics, Outlets, Waveform
from vstent.geometry.vessel import Anatomy
from vstent.io.archive import load_data, save_data
from vstent.io.dicom_writer import write_dicom
from vstent.io.images import read_image
from vstent.io.writers import write_stl
from vstent.plan.ranges import Ranges
from vstent.study import store as stored
from vstent.study.contrast import NUMBERS
from vstent.study.folder import CACHE
from vstent.study.keys import angiogram_key, hash_of, study_keys
from vstent.study.ranking_flows import FlowStore
from vstent.study.repeat import settings_of
from vstent.study.settings import InputSettings, Settings


def alone(device, **given):
    """A treatment of one device, as a client states it."""
    return {"name": device, "implants": [{"id": device, "device": device} | given]}


def wanted(treatment, **given):
    """What is asked of the first implant of a treatment."""
    return {"treatment": treatment, "implant": treatment["implants"][0]["id"]} | given


SILK = alone("silk")
TWO = {
    "name": "two",
    "implants": [
        {"id": "outer", "device": "silk"},
        {"id": "inner", "device": "silk", "placing": {"shift_mm": -4.0}, "inside": ["outer"]},
    ],
}
"""A treatment of two implants, the second inside the first and further upstream."""


@pytest.fixture(scope="module")
def artery(tmp_path_factory):
    path = tmp_path_factory.mktemp("input") / "phantom.stl"
    write_stl(path, app_case.phantom_surface())
    return path


@pytest.fixture(scope="module")
def two_sacs(tmp_path_factory):
    path = tmp_path_factory.mktemp("input") / "two.stl"
    write_stl(path, app_case.two_sacs_surface())
    return path


@pytest.fixture(scope="module")
def study(artery, tmp_path_factory):
    """The same at the command line."""
    out = tmp_path_factory.mktemp("study") / "study"
    command = ["run", str(artery), "--out", str(out), "--device", "silk", "--units", "mm", "--no-flow"]
    assert main(command) == 0
    return out


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return tmp_path_factory.mktemp("cases")


@pytest.fixture(scope="module")
def client(workspace):
    with app_case.served(workspace) as client:
        yield client


@pytest.fixture(scope="module")
def case(client, artery):
    """A case brought in by HTTP, its vessel found; Silk alone is chosen, no flow is wanted."""
    case = client.post("/api/cases", json={"name": "Phantom"}).json()
    answer = client.put(f"/api/cases/{case['id']}/input", params={"name": "phantom.stl"}, content=artery.read_bytes())
    assert answer.json() == {"taken": True}
    choices = case["choices"] | {"treatments": [SILK], "flow": {"is_wanted": False}, "units": "mm"}
    client.put(f"/api/cases/{case['id']}/choices", json={"revision": case["revision"], "choices": choices})
    client.post(f"/api/cases/{case['id']}/input/done")
    view = app_case.wait(client, case["id"])
    assert view["failed"] == {}
    assert [view["steps"][step] for step in STEPS[:3]] == ["done"] * 3
    return f"/api/cases/{case['id']}"


def anatomy_of(client, case, workspace):
    path = next((workspace / client.get(case).json()["id"] / CACHE).glob("anatomy-*.npz"))
    return load_data(path, Anatomy)


def choose(client, case, **changes):
    view = client.get(case).json()
    body = {"revision": view["revision"], "choices": view["choices"] | changes}
    return client.put(f"{case}/choices", json=body)


def test_command_line_rest_and_python_find_the_same_numbers(client, case, artery, study, tmp_path):
    client.post(f"{case}/jobs/flow")
    view = app_case.wait(client, case.rpartition("/")[2])
    assert set(view["steps"].values()) == {"done"}
    by_rest = client.get(f"{case}/files/metrics.json").json()
    by_cli = json.loads((study / "metrics.json").read_text())
    settings = Settings(InputSettings(units="mm"), treatments=(with_device("silk"),), flow=None)
    vstent.run(artery, tmp_path / "python", settings, lambda *_: None)
    by_python = json.loads((tmp_path / "python" / "metrics.json").read_text())
    assert by_rest == by_cli == by_python
    assert by_rest["treatments"]["silk"]["implants"]["silk"]["deployed_length_mm"] > 10
    report = client.get(f"{case}/files/report.html")
    assert "Silk" in report.text
    proposed = client.get(f"{case}/proposed").json()
    assert proposed["cost"].startswith("Grid spacing")
    assert proposed["inflow_source"].startswith("assumed")
    assert "sandbox" in report.headers["content-security-policy"]


def test_voxels_without_a_header_wait_for_their_number_and_size(client):
    voxels = np.full((24, 20, 16), 10, dtype=np.uint8)
    voxels[6:18, 6:14, 4:12] = 200
    bare = client.post("/api/cases", json={"name": "bare voxels"}).json()["id"]
    client.put(f"/api/cases/{bare}/input", params={"name": "scan.raw"}, content=voxels.tobytes())
    client.post(f"/api/cases/{bare}/input/done")
    case = f"/api/cases/{bare}"
    view = client.get(case).json()
    assert view["wants_grid"]
    assert (view["job"], view["failed"]) == (None, {})
    for spacing_mm in ([0.5, 0.25, 2.0], [0.3, 0.3, 0.3]):
        assert not choose(client, case, spacing_mm=spacing_mm, shape=[16, 20, 24]).json()["wants_grid"]
        told = client.get(f"{case}/image").json()
        assert (told["shape"], told["spacing_mm"]) == ([16, 20, 24], pytest.approx(spacing_mm))
    waiting = client.post(f"{case}/input/done", params={"look_first": True}).json()
    assert (waiting["job"], waiting["steps"]["image"]) == (None, "todo")


def test_a_case_takes_one_scan(client, case, artery):
    answer = client.put(f"{case}/input", params={"name": "other.stl"}, content=artery.read_bytes())
    assert answer.status_code == 422
    assert "Make another case for other.stl." in answer.json()["detail"]
    two = f"/api/cases/{client.post('/api/cases', json={'name': 'two'}).json()['id']}"
    for name in ("one.stl", "other.stl"):
        assert client.put(f"{two}/input", params={"name": name}, content=artery.read_bytes()).status_code == 200
    answer = client.post(f"{two}/input/done")
    assert answer.status_code == 422
    assert "one.stl and other.stl" in answer.json()["detail"]


def test_a_header_and_the_voxels_that_it_names_are_one_scan(tmp_path):
    (tmp_path / intake.FOLDER).mkdir()
    (tmp_path / intake.FOLDER / "a.raw").write_bytes(bytes(8))
    header = tmp_path / intake.FOLDER / "b.mhd"
    header.write_text("ObjectType = Image\nNDims = 3\nDimSize = 2 2 2\nElementDataFile = a.raw\n")
    assert intake.found(tmp_path) == f"{intake.FOLDER}/b.mhd"
    (tmp_path / intake.FOLDER / "c.raw").write_bytes(bytes(8))
    with pytest.raises(ReadError, match=r"b.mhd and c.raw"):
        intake.found(tmp_path)


@pytest.mark.parametrize(
    ("way", "status", "words"),
    [
        ("/api/cases/unheard-of", 404, "This case does not exist."),
        ("/assets/unheard-of", 404, "This file does not exist."),
        ("{case}/flow?cut_mm=nan", 422, "finite"),
        ("{case}/image/surface?threshold=inf", 422, "finite"),
    ],
)
def test_what_is_not_there_and_what_is_no_number_is_said_so(client, case, workspace, way, status, words):
    answer = client.get(way.format(case=case))
    assert answer.status_code == status
    assert words in answer.text
    assert str(workspace) not in answer.text


def test_a_place_for_a_deployment_is_one_of_the_choices(client, case):
    assert client.post(f"{case}/deployment", json=wanted(SILK, abscissa_mm=12.0)).status_code == 422


def test_a_case_without_a_scan_says_so(client):
    empty = client.post("/api/cases", json={"name": "empty"}).json()["id"]
    assert "no scan yet" in client.get(f"/api/cases/{empty}/image").json()["detail"]


def test_a_second_tab_cannot_undo_what_the_first_has_done(client, case):
    before = client.get(case).json()
    assert choose(client, case, inlet_mm=[1.0, 2.0, 3.0]).status_code == 200
    late = client.put(
        f"{case}/choices", json={"revision": before["revision"], "choices": before["choices"] | {"threshold": 9.0}}
    )
    assert late.status_code == 409
    now = client.get(case).json()
    assert now["choices"]["inlet_mm"] == [1.0, 2.0, 3.0]
    assert now["choices"]["threshold"] is None
    # What depends on the inlet is out of date and not gone; the image does not depend on it.
    assert now["steps"]["image"] == "done"
    assert {now["steps"][step] for step in ("vessel", "sac")} == {"stale"}
    assert client.get(f"{case}/anatomy").status_code == 200
    undone = client.post(f"{case}/undo", json={"revision": now["revision"]}).json()
    assert undone["choices"] == before["choices"]
    assert undone["steps"] == before["steps"]
    redone = client.post(f"{case}/redo", json={"revision": undone["revision"]}).json()
    assert redone["choices"] == now["choices"]
    client.post(f"{case}/undo", json={"revision": redone["revision"]})


@pytest.mark.parametrize(
    "changes",
    [
        {"treatments": [SILK, SILK]},
        {"treatments": [{"name": "silk", "implants": []}]},
        {"treatments": [alone("silk", nonsense=1)]},
        {"treatments": [alone("silk", inside=["enterprise"])]},
        {"treatments": [{"name": "../silk", "implants": SILK["implants"]}]},
        {"inlet_mm": [1.0, 2.0]},
        {"inlet_mm": [1.0, 2.0, 1e9]},
        {"flow": {"cell_size_mm": 0.001}},
        {"nonsense": 1},
        {"threshold": "high"},
        {"shape": [-1, 0, 3]},
    ],
)
def test_choices_that_mean_nothing_are_refused(client, case, changes):
    before = client.get(case).json()
    assert choose(client, case, **changes).status_code == 422
    assert client.get(case).json()["revision"] == before["revision"]


def test_a_dragged_end_lies_where_the_hand_is_and_where_the_deployment_puts_it(client, case, workspace):
    anatomy = anatomy_of(client, case, workspace)
    design = find_design("silk")
    for anchor, end in (("proximal", 0), ("distal", 1)):
        start, _ = app_case.opened(client.post(f"{case}/sketch", json=wanted(SILK)))
        there_mm = start["ends_mm"][end] + 1.3
        answer = client.post(f"{case}/sketch", json=wanted(SILK, anchor=anchor, abscissa_mm=there_mm))
        sketched, data = app_case.opened(answer)
        assert sketched["ends_mm"][end] == pytest.approx(there_mm, abs=1e-3)
        stent = deploy(design, anatomy, landing=Landing(sketched["center_mm"])).stent
        ends = (stent.proximal_abscissa_mm, stent.distal_abscissa_mm)
        np.testing.assert_allclose(sketched["ends_mm"], ends, atol=0.1)
        # The end in hand stays there; how sure the artery's diameter is shows at the other one.
        widths = [high - low for low, high in sketched["ends_band_mm"]]
        assert widths[end] == pytest.approx(0, abs=1e-6)
        low, high = sketched["ends_band_mm"][1 - end]
        assert low < ends[1 - end] < high
        (wires,) = sketched["layers"]
        points = app_case.numbers(wires["points"], data)
        apart = np.linalg.norm(points - stent.wire_points_mm, axis=1)
        assert np.median(apart) < 0.06


@pytest.mark.parametrize(
    ("anchor", "abscissa_mm", "said"),
    [("proximal", -5, "is not on the parent artery"), ("distal", 5, "beyond the proximal end")],
)
def test_a_device_dragged_out_of_the_artery_is_refused_with_a_sentence(client, case, anchor, abscissa_mm, said):
    answer = client.post(f"{case}/sketch", json=wanted(SILK, anchor=anchor, abscissa_mm=abscissa_mm))
    assert answer.status_code == 422
    assert said in answer.json()["detail"]


def test_a_number_that_json_does_not_know_is_refused_by_its_name(client, case):
    body = json.dumps(wanted(SILK, anchor="distal", abscissa_mm=float("nan")))
    answer = client.post(f"{case}/sketch", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 422
    (fault,) = answer.json()["detail"]
    assert (fault["loc"][-1], fault["msg"]) == ("abscissa_mm", "Input should be a finite number")


def test_deployed_numbers_are_those_of_the_measures(client, case, workspace):
    anatomy = anatomy_of(client, case, workspace)
    center_mm = round(anatomy.parent.axis.length_mm / 2, 3)
    silk = alone("silk", placing={"position_mm": center_mm})
    assert choose(client, case, treatments=[silk]).status_code == 200
    told, data = app_case.opened(client.post(f"{case}/deployment", json=wanted(silk, colour="coverage")))
    deployment = deploy(find_design("silk"), anatomy, landing=Landing(center_mm))
    measures = measure(anatomy, deployment)
    assert told["length_mm"] == pytest.approx(measures["deployed_length_mm"], rel=1e-9)
    row = next(row for row in told["measures"][0]["rows"] if row["key"] == "deployed_length_mm")
    assert float(row["cells"][0].split("\u202f")[0]) == pytest.approx(measures["deployed_length_mm"], rel=5e-3)
    assert row["meaning"]
    (spanned,) = [row for row in told["measures"][0]["rows"] if row["key"] == "neck_covered_fraction"]
    assert spanned["is_first"]
    sheet = client.post(f"{case}/bands", json=wanted(silk)).json()
    lengths = next(row for row in sheet["rows"] if row[0] == "Deployed length")
    low, value, high = (float(lengths[k].split("\u202f")[0]) for k in (2, 1, 3))
    assert low < value < high
    assert "Silk is described by 5 numbers: 2 cited" in sheet["sentence"]
    with_gaps = client.post(f"{case}/bands?gaps=true", json=wanted(silk), timeout=300).json()
    assert [row for row in with_gaps["rows"] if row in sheet["rows"]] == sheet["rows"]
    assert len(with_gaps["rows"]) == len(sheet["rows"]) + 2
    assert client.post(f"{case}/bands", json=wanted(silk)).json() == with_gaps  # they are kept
    wires = next(layer for layer in told["layers"] if layer["id"] == "wires")
    coverage = app_case.numbers(wires["values"], data)
    assert coverage.mean() == pytest.approx(100 * measures["metal_coverage_fraction"], rel=0.05)
    steps = client.get(case).json()["steps"]
    assert (steps["device"], steps["deploy"]) == ("done", "done")
    choose(client, case, treatments=[SILK])


def test_the_section_has_the_phantoms_radius(client, case, workspace):
    start, _ = app_case.opened(client.post(f"{case}/sketch", json=wanted(SILK)))
    place = start["ends_mm"][0] + 1.0
    section = client.post(f"{case}/section", json={"abscissa_mm": place, "treatment": SILK, "implant": "silk"}).json()
    assert client.post(f"{case}/section", json={"abscissa_mm": 2000.0}).status_code == 422
    segments = np.array(section["landing"]).reshape(-1, 2, 2)
    near = np.linalg.norm(segments, axis=2).max(axis=1) < section["artery_diameter_mm"]
    length = np.linalg.norm(segments[near, 1] - segments[near, 0], axis=1).sum()
    assert length / np.pi == pytest.approx(section["artery_diameter_mm"], rel=0.03)
    middle_mm = anatomy_of(client, case, workspace).parent.axis.at(np.array([place]))[0]
    phantom = phantoms.demo_phantom().parent
    nearest = np.linalg.norm(phantom.points_mm - middle_mm, axis=1).argmin()
    assert section["artery_diameter_mm"] == pytest.approx(2 * phantom.inscribed_radius_mm[nearest], rel=0.01)
    assert section["device_diameter_mm"] < section["artery_diameter_mm"]


def test_without_an_aneurysm_no_device_is_proposed_until_the_user_says_that_there_is_none(client, tmp_path):
    write_stl(tmp_path / "healthy.stl", phantoms.phantom_surface(phantoms.siphon(), edge_mm=0.4))
    case = f"/api/cases/{client.post('/api/cases', json={'name': 'healthy'}).json()['id']}"
    client.put(f"{case}/input?name=healthy.stl", content=(tmp_path / "healthy.stl").read_bytes())
    choose(client, case, units="mm")
    client.post(f"{case}/input/done")
    view = app_case.wait(client, case.rpartition("/")[2])
    assert view["has_anatomy"]
    assert view["failed"]["sac"].startswith("No aneurysm was found")  # by which the page knows it
    assert [view["steps"][step] for step in STEPS[:5]] == ["done", "done", "failed", "todo", "todo"]
    assert client.get(f"{case}/proposed").json()["sizes"] == {}
    for route in ("sketch", "deployment"):
        answer = client.post(f"{case}/{route}", json=wanted(SILK))
        assert (answer.status_code, "No aneurysm was found" in answer.text) == (422, True)
    for kind in ("rank", "flow"):
        client.post(f"{case}/jobs/{kind}")
        assert "No aneurysm was found" in str(app_case.wait(client, case.rpartition("/")[2])["failed"])
    choose(client, case, without_aneurysm=True)
    client.post(f"{case}/jobs/anatomy")
    assert app_case.wait(client, case.rpartition("/")[2])["steps"]["sac"] == "done"
    assert set(client.get(f"{case}/proposed").json()["sizes"]) == {"silk", "enterprise"}
    assert client.post(f"{case}/deployment", json=wanted(SILK)).status_code == 200


def test_of_several_sacs_each_has_its_place_and_its_numbers(client, two_sacs):
    case = f"/api/cases/{client.post('/api/cases', json={'name': 'two'}).json()['id']}"
    client.put(f"{case}/input?name=two.stl", content=two_sacs.read_bytes())
    client.post(f"{case}/input/done")
    app_case.wait(client, case.rpartition("/")[2])
    first, second = app_case.opened(client.get(f"{case}/anatomy"))[0]["sacs"]
    assert first["volume_mm3"] > 2 * second["volume_mm3"]
    tables = client.get(f"{case}/numbers").json()["anatomy"]
    assert [table["title"] for table in tables] == ["Sac 1", "Sac 2"]
    for table, sac in zip(tables, (first, second), strict=True):
        (volume,) = [row["cells"][0] for row in table["rows"] if row["key"] == "sac_volume_mm3"]
        assert float(volume.split()[0]) == pytest.approx(sac["volume_mm3"], rel=0.01)
    choose(client, case, at_mm=second["center_mm"])
    client.post(f"{case}/jobs/anatomy")
    app_case.wait(client, case.rpartition("/")[2])
    (chosen,) = app_case.opened(client.get(f"{case}/anatomy"))[0]["sacs"]
    assert chosen["center_mm"] == pytest.approx(second["center_mm"], abs=0.1)


def test_every_size_is_ranked_and_a_click_chooses_one(client, case):
    choose(client, case, treatments=[alone("enterprise")])
    client.post(f"{case}/jobs/rank")
    view = app_case.wait(client, case.rpartition("/")[2])
    assert view["failed"] == {}
    found = client.get(f"{case}/ranking").json()
    assert found["is_current"]
    assert [row["rank"] for row in found["rows"]] == list(range(1, 1 + len(find_design("enterprise").sizes)))
    first, *others = (row for row in found["rows"] if row["is_suitable"])
    assert [row["is_proposed"] for row in found["rows"]].count(True) == 1
    scores = [row["score"] for row in (first, *others)]
    assert scores == sorted(scores, reverse=True)
    assert all(row["reason"] for row in found["rows"])
    columns = {column["key"]: column for column in found["columns"]}
    assert columns["landing_length_mm"]["meaning"]
    assert all(column["meaning"] and key in first for key, column in columns.items())
    choose(client, case, treatments=[SILK])
    assert not client.get(f"{case}/ranking").json()["is_current"]


def test_sizes_side_by_side_are_the_deployments_on_one_scale(client, case):
    sizes = [alone("silk", diameter_mm=4.0, length_mm=length) for length in (15.0, 20.0)]
    treatments = [*sizes, alone("enterprise")]
    asked = {"treatments": treatments, "colour": "wall_gap"}
    told, data = app_case.opened(client.post(f"{case}/comparison", json=asked))
    assert [one["pane"] for one in told["compared"]] == ["compared 0", "compared 1", "compared 2"]
    assert [scale["id"] for scale in told["scales"]] == ["wall_gap"]
    assert told["compared"][0]["title"] == "Silk 4 × 15 mm"
    for treatment, one in zip(treatments, told["compared"], strict=True):
        single, single_data = app_case.opened(client.post(f"{case}/deployment", json=wanted(treatment)))
        assert one["measures"] == single["measures"]
        both = [
            app_case.numbers(next(x for x in said["layers"] if (x["id"], x["pane"]) == ("wires", pane))["points"], raw)
            for said, raw, pane in ((told, data, one["pane"]), (single, single_data, treatment["name"]))
        ]
        np.testing.assert_allclose(*both, atol=2e-3)
    assert client.post(f"{case}/comparison", json={"treatments": 5 * [SILK]}).status_code == 422


def wires_of(said, raw, pane):
    """Points of the wires in a pane of a message, one array per implant."""
    layers = [layer for layer in said["layers"] if (layer["id"], layer["pane"]) == ("wires", pane)]
    return [app_case.numbers(layer["points"], raw) for layer in layers]


def test_of_two_implants_the_inner_opens_in_the_outer_and_is_deployed_again_where_that_moves(client, case, workspace):
    anatomy, silk = anatomy_of(client, case, workspace), find_design("silk")
    outer = deploy(silk, anatomy)
    place = propose_landing(silk, anatomy, outer.stent.size)
    inner_at = replace(place, abscissa_mm=place.abscissa_mm - 4.0)
    inner = deploy(silk, anatomy, landing=inner_at, inside=[outer.stent])
    told, raw = app_case.opened(client.post(f"{case}/deployment", json=wanted(TWO, implant="inner")))
    assert (told["treatment"], told["implant"]) == ("two", "inner")
    assert told["title"] == "Silk 4 × 15 mm + Silk 4 × 15 mm"
    assert told["length_mm"] == pytest.approx(inner.stent.deployed_length_mm, rel=1e-9)
    titles = ["1. Silk 4 × 15 mm", "2. Silk 4 × 15 mm", "All devices together"]
    assert [sheet["title"] for sheet in told["measures"]] == titles
    for found, one in zip(wires_of(told, raw, "two"), (outer, inner), strict=True):
        np.testing.assert_allclose(found, one.stent.wire_points_mm, atol=2e-3)
    # Dragged, the inner one opens in the outer one too.
    dragged = wanted(TWO, implant="inner", anchor="proximal", abscissa_mm=told["ends_mm"][0] + 1.0)
    sketched, _ = app_case.opened(client.post(f"{case}/sketch", json=dragged))
    there = deploy(silk, anatomy, landing=Landing(sketched["center_mm"]), inside=[outer.stent]).stent
    assert sketched["ends_mm"] == pytest.approx([there.proximal_abscissa_mm, there.distal_abscissa_mm], abs=0.1)
    # While the outer one is dragged, the inner one follows it.
    there_mm = told["ends_mm"][0] - 2.0
    dragged = wanted(TWO, implant="outer", anchor="proximal", abscissa_mm=there_mm)
    sketched, raw = app_case.opened(client.post(f"{case}/sketch", json=dragged))
    assert sketched["ends_mm"][0] == pytest.approx(there_mm, abs=1e-3)
    followed_mm = wires_of(sketched, raw, "two")[1]
    # Let go, it opens in the outer one at its new place.
    moved = deploy(silk, anatomy, landing=Landing(sketched["center_mm"]))
    again = deploy(silk, anatomy, landing=inner_at, inside=[moved.stent])
    placed = {"placing": {"position_mm": sketched["center_mm"]}}
    both = TWO | {"implants": [TWO["implants"][0] | placed, TWO["implants"][1]]}
    told, raw = app_case.opened(client.post(f"{case}/deployment", json=wanted(both, implant="outer")))
    np.testing.assert_allclose(wires_of(told, raw, "two")[1], again.stent.wire_points_mm, atol=2e-3)
    assert np.abs(again.stent.wire_points_mm - inner.stent.wire_points_mm).max() > 0.02
    apart_mm = again.stent.contour.closest(followed_mm)[1]
    assert apart_mm.mean() < 0.05
    refused = client.post(f"{case}/deployment", json=wanted(TWO, implant="third"))
    assert (refused.status_code, "not among the implants" in refused.json()["detail"]) == (422, True)


def test_a_basket_is_deployed_measured_and_moved_along_the_axis_of_the_sac(client, case, workspace):
    anatomy, web = anatomy_of(client, case, workspace), alone("web_sl")
    assert choose(client, case, treatments=[web]).status_code == 200
    proposed = deploy(find_design("web_sl"), anatomy)
    told, raw = app_case.opened(client.post(f"{case}/deployment", json=wanted(web)))
    np.testing.assert_allclose(wires_of(told, raw, "web_sl")[0], proposed.stent.wire_points_mm, atol=2e-3)
    assert (told["size"], told["advice"]) == (proposed.stent.size.label, proposed.advice)
    assert told["length_mm"] == pytest.approx(measure(anatomy, proposed)["basket_height_mm"], rel=1e-9)
    rows = [row["key"] for row in told["measures"][0]["rows"] if row["is_first"]]
    assert rows[:5] == ["basket_width_mm", "basket_height_mm", "width_compression_fraction", "protrusion_mm",
                        "neck_uncovered_fraction"]  # fmt: skip
    low = proposed.stent.nodes_mm[0].mean(axis=0)
    axis_mm = np.reshape(told["axis"]["points"], (-1, 3))
    on_axis_mm = axis_mm[np.searchsorted(told["axis"]["abscissa"], told["ends_mm"][0])]
    assert np.linalg.norm(low - on_axis_mm) < 0.3
    # Moved down, it lies as the command line puts it, and is chosen there as a shift.
    moved = wanted(web, anchor="proximal", abscissa_mm=-1.0, colour="coverage")
    sketched, raw = app_case.opened(client.post(f"{case}/sketch", json=moved))
    shifted = alone("web_sl", placing={"shift_mm": -1.0})
    there = deploy(find_design("web_sl"), anatomy, size=proposed.stent.size, landing=Landing(-1.0, "proximal"))
    for answer in ((sketched, raw), app_case.opened(client.post(f"{case}/deployment", json=wanted(shifted)))):
        assert answer[0]["ends_mm"][0] == pytest.approx(there.stent.proximal_abscissa_mm, abs=1e-6)
        np.testing.assert_allclose(wires_of(*answer, "web_sl")[0], there.stent.wire_points_mm, atol=2e-3)
    assert client.post(f"{case}/bands", json=wanted(web)).json()["rows"] == []
    section = client.post(f"{case}/section", json={"abscissa_mm": 2.0, "treatment": web}).json()
    assert (section["rings"], "device_diameter_mm" in section) == ([], False)
    assert client.get(f"{case}/plan.pdf").content.count(b"/MediaBox") == 1
    refused = client.post(f"{case}/jobs/rank")
    assert (refused.status_code, "baskets and coils are not ranked" in refused.json()["detail"]) == (422, True)
    inner = {"id": "web", "device": "web_sl", "inside": ["silk"]}
    both = {"name": "both", "implants": [SILK["implants"][0], inner]}
    refused = client.post(f"{case}/deployment", json=wanted(both))
    assert (refused.status_code, "lies in a sac alone" in refused.json()["detail"]) == (422, True)
    choose(client, case, treatments=[SILK])


def test_coils_are_shown_as_the_study_has_placed_them(client, case, workspace):
    anatomy, treatment = anatomy_of(client, case, workspace), read_treatment("coils(4%)")
    chosen = asdict(treatment)
    assert choose(client, case, treatments=[chosen]).status_code == 200
    told, raw = app_case.opened(client.post(f"{case}/deployment", json=wanted(chosen)))
    assert (told["is_placed"], told["measures"], wires_of(told, raw, "coils")) == (False, [], [])
    refused = client.get(f"{case}/plan.pdf")
    assert (refused.status_code, "These coils are not placed yet" in refused.json()["detail"]) == (422, True)
    design, sac = find_design("coils"), anatomy.aneurysms[0].sac
    turn = np.linspace(0.0, 2 * np.pi, 50)
    loop_mm = sac.vertices_mm.mean(axis=0) + np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    flat = np.zeros((0, 0, 3)), np.zeros(0), loop_mm, np.array([0, 50]), np.array([design.wound_diameter_um])
    coils = Coils(design, design.sizes[0], *flat, coils=design.sizes[:1], sac=sac)
    none = {"history_mm": np.zeros((1, 0, 0, 3)), "energy_mm2": np.zeros(1), "wall_gap_mm": np.zeros((0, 0))}
    placed = Deployment(coils, "terminated", "One loop.", terminated_fraction=np.ones(1), seconds=0.0, **none)
    state = Cases(workspace).get(case.rpartition("/")[2]).state
    key = study_keys(state.source, replace(state.settings(), treatments=(treatment,)))["deploy coils"]
    folder = workspace / case.rpartition("/")[2]
    stored.Store(folder / CACHE).save("deploy coils", key, placed)
    told, raw = app_case.opened(client.post(f"{case}/deployment", json=wanted(chosen)))
    assert (told["is_coils"], told["is_placed"], told["advice"]) == (True, True, "One loop.")
    np.testing.assert_allclose(wires_of(told, raw, "coils")[0], loop_mm, atol=2e-3)
    assert client.get(f"{case}/proposed").json()["sizes"] == {}
    choose(client, case, treatments=[SILK])


def test_stents_at_a_fork_are_shown_and_moved_on_their_own_paths(client, tmp_path):
    write_stl(tmp_path / "fork.stl", phantoms.phantom_surface(PHANTOM, edge_mm=0.3))
    name = client.post("/api/cases", json={"name": "fork"}).json()["id"]
    case = f"/api/cases/{name}"
    client.put(f"{case}/input", params={"name": "fork.stl"}, content=(tmp_path / "fork.stl").read_bytes())
    client.post(f"{case}/input/done")
    app_case.wait(client, name)
    both = asdict(read_treatment("enterprise 4.5x22 > outlet_1 + enterprise 4.5x22 > outlet_2"))
    assert choose(client, case, treatments=[both]).status_code == 200
    first, second = (implant["id"] for implant in both["implants"])
    told, raw = app_case.opened(client.post(f"{case}/deployment", json=wanted(both, implant=second)))
    axis_mm = np.reshape(told["axis"]["points"], (-1, 3))
    at_mm = axis_mm[np.searchsorted(told["axis"]["abscissa"], told["ends_mm"][1])]
    distal_mm = wires_of(told, raw, both["name"])[1]
    assert np.linalg.norm(distal_mm - at_mm, axis=1).min() < 2.0  # the radius of the arm
    assert told["ends_mm"][0] < told["neck"][0] < told["neck"][1] < told["ends_mm"][1]
    # Dragged, the second one passes through the first again.
    at_mm = told["ends_mm"][0] - 0.5
    dragged = wanted(both, implant=second, anchor="proximal", abscissa_mm=at_mm)
    sketched, moved = app_case.opened(client.post(f"{case}/sketch", json=dragged))
    assert sketched["ends_mm"][0] == pytest.approx(at_mm, abs=0.3)
    wires_mm = [wires_of(*answer, both["name"])[0] for answer in ((told, raw), (sketched, moved))]
    np.testing.assert_allclose(wires_mm[0], wires_mm[1], atol=4e-3)
    section = client.post(f"{case}/section", json={"abscissa_mm": 8.0, "treatment": both}).json()
    assert section["rings"] == []  # it is across the parent artery
    assert client.post(f"{case}/bands", json=wanted(both, implant=first)).status_code == 200


def test_a_section_through_two_implants_has_both_and_the_diameters_of_one(client, case):
    choose(client, case, treatments=[TWO])
    told, _ = app_case.opened(client.post(f"{case}/deployment", json=wanted(TWO, implant="inner")))
    both_mm = told["ends_mm"][1] - 1.0  # the outer one reaches further
    widths = []
    for implant in ("outer", "inner"):
        query = {"abscissa_mm": both_mm, "treatment": TWO, "implant": implant}
        section = client.post(f"{case}/section", json=query).json()
        assert len(section["rings"]) == 2
        widths.append(section["device_diameter_mm"])
    assert widths[1] < widths[0] - 0.1  # by two wires
    query = {"abscissa_mm": told["ends_mm"][0] + 1.0, "treatment": TWO, "implant": "outer"}
    section = client.post(f"{case}/section", json=query).json()
    assert (len(section["rings"]), "device_diameter_mm" in section) == (1, False)
    sheet = client.post(f"{case}/bands", json=wanted(TWO, implant="inner")).json()
    assert (sheet["treatment"], sheet["implant"]) == ("two", "inner")
    assert client.get(f"{case}/plan.pdf").content.count(b"/MediaBox") == 2
    choose(client, case, treatments=[SILK])
    assert client.post(f"{case}/section", json=query).json() == section  # asked for while another choice is stored


def test_flows_of_the_best_sizes_join_a_ranking_that_is_there_before(artery, tmp_path, monkeypatch):
    """The flows are those of `rank_flows`, given the number that was chosen and a store in the case folder."""
    asked = {}

    def flows(anatomy, found, settings, count, *, stored, keep, progress):
        asked.update(count=count, store=type(stored), before=json.loads((folder / "ranking.json").read_text()))
        progress(0, 3, "no device")
        field = FlowField.__new__(FlowField)
        for one in (None, *found.candidates):
            keep(one, field)
        best, *others = found.candidates
        best = replace(best, measures=best.measures | {"neck_inflow_change_fraction": -0.4})
        return replace(found, candidates=(best, *others))

    case = Cases(tmp_path).create("ranked")
    folder = case.folder
    shutil.copy(artery, folder / "artery.stl")
    choices = case.state.choices.model_copy(update={"treatments": (with_device("enterprise"),), "ranking_flows": 2})
    case.update(input="artery.stl", source=hash_of(folder / "artery.stl"), choices=choices)
    monkeypatch.setattr(ranking, "rank_flows", flows)
    kept = []
    monkeypatch.setattr(stored.Store, "save", lambda _, name, key, field: kept.append((name, key)))
    said = []
    ranking.rank_sizes(case, lambda now: said.append((now.stage, now.fraction, now.detail)))
    assert asked["count"] == 2
    assert asked["store"] is FlowStore
    keys = study_keys(case.state.source, case.state.settings())  # the step Flow finds those that it would compute
    assert kept == [(name, keys[name]) for name in ("flow bare", "flow enterprise")]
    after = json.loads((folder / "ranking.json").read_text())
    assert "neck_inflow_change_fraction" not in {column["key"] for column in asked["before"]["columns"]}
    assert "neck_inflow_change_fraction" in {column["key"] for column in after["columns"]}
    assert after["rows"][0]["neck_inflow_change_fraction"] == -0.4
    assert ("rank_flow", 0.0, "0 of 3: no device") in said
    assert said[-1][:2] == ("rank_flow", 1.0)


def test_a_job_computes_what_was_chosen_when_it_was_started(client, case):
    before = client.get(case).json()
    client.post(f"{case}/jobs/flow")
    changed = choose(client, case, treatments=[alone("enterprise")]).json()  # before the job has loaded its modules
    assert changed["job"]["stage"] == ""
    app_case.until(lambda: client.get(case).json()["job"]["stage"])
    client.post(f"{case}/undo", json={"revision": changed["revision"]})
    view = app_case.wait(client, case.rpartition("/")[2])
    assert view["choices"] == before["choices"]
    assert set(view["steps"].values()) == {"done"}
    assert list(client.get(f"{case}/files/metrics.json").json()["treatments"]) == ["silk"]


def test_a_failure_is_told_while_what_caused_it_is_chosen(client, case):
    choose(client, case, treatments=[alone("unheard-of")])
    client.post(f"{case}/jobs/flow")
    failed = app_case.wait(client, case.rpartition("/")[2])
    assert "unheard-of" in failed["failed"]["flow"]
    assert failed["steps"]["flow"] == "failed"
    listed = client.get("/api/cases").json()["cases"]
    assert [one["changed_s"] for one in listed] == sorted((one["changed_s"] for one in listed), reverse=True)
    assert [(one["failed"], one["job"]) for one in listed if one["id"] == failed["id"]] == [(["flow"], "")]
    chosen = choose(client, case, treatments=[SILK]).json()
    assert chosen["failed"] == {}
    assert "failed" not in chosen["steps"].values()
    undone = client.post(f"{case}/undo", json={"revision": chosen["revision"]}).json()
    assert undone["failed"] == failed["failed"]
    choose(client, case, treatments=[SILK])


def test_a_flow_after_another_choice_of_the_vessel_finds_the_vessel_first(client, case):
    before = client.get(case).json()
    changed = choose(client, case, upstream_mm=12.0).json()
    assert changed["steps"]["vessel"] == "stale"
    client.post(f"{case}/jobs/flow")
    app_case.until(lambda: client.get(case).json()["anatomy"] != before["anatomy"])
    view = client.delete(f"{case}/jobs").json()  # the former anatomy is not kept any more
    assert [view["steps"][step] for step in STEPS[:3]] == ["done"] * 3
    assert client.get(f"{case}/anatomy").status_code == 200
    choose(client, case, upstream_mm=None)
    client.post(f"{case}/jobs/anatomy")
    app_case.wait(client, case.rpartition("/")[2])


def test_a_job_is_stopped_within_a_second_and_said_so(client, case):
    client.post(f"{case}/jobs/anatomy")
    time.sleep(0.3)
    began = time.monotonic()
    view = client.delete(f"{case}/jobs").json()
    assert time.monotonic() - began < 1.0
    assert view["job"] is None
    assert view["failed"]["image"].startswith("Stopped")


def test_a_tab_is_told_of_every_change(client, case):
    with client.stream("GET", f"{case}/events") as events:
        lines = (line for line in events.iter_lines() if line.startswith("data: "))
        first = json.loads(next(lines)[6:])
        answer = choose(client, case, threshold=123.0).json()
        assert answer["revision"] == first["revision"] + 1
        second = json.loads(next(lines)[6:])
    assert (second["revision"], second["choices"]["threshold"]) == (answer["revision"], 123.0)
    client.post(f"{case}/undo", json={"revision": second["revision"]})


def test_a_server_that_was_killed_at_work_goes_on_when_it_starts_again(artery, tmp_path):
    with app_case.served(tmp_path, artery) as client:
        case = client.get("/api/cases").json()["opened"]
        app_case.until(lambda: client.get(f"/api/cases/{case}").json()["job"])
    state = json.loads((tmp_path / case / "app.json").read_text())
    assert (state["job"], state["anatomy"]) == ("anatomy", "")
    with app_case.served(tmp_path) as client:
        assert client.get(f"/api/cases/{case}").json()["job"]["kind"] == "anatomy"
        assert client.delete(f"/api/cases/{case}/jobs").json()["job"] is None


def test_a_folder_of_vstent_run_opens_with_all_that_it_holds(study, tmp_path):
    with app_case.served(tmp_path / "cases", study) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        view = client.get(case).json()
        assert [treatment["name"] for treatment in view["choices"]["treatments"]] == ["silk"]
        assert view["choices"]["units"] == "mm"
        assert not view["choices"]["flow"]["is_wanted"]
        assert [step for step in STEPS if view["steps"][step] == "done"] == list(STEPS[:5])
        told, _ = app_case.opened(client.post(f"{case}/deployment", json=wanted(SILK)))
        measured = json.loads((study / "metrics.json").read_text())["treatments"]["silk"]["implants"]["silk"]
        assert told["length_mm"] == pytest.approx(measured["deployed_length_mm"], rel=1e-6)


def keep_flow(folder, source, settings, name):
    """Keep a flow as a study of these settings does."""
    key = study_keys(source, settings)[f"flow {name}"]
    stored.Store(folder / CACHE).save(f"flow {name}", key, report_case.field(1.0))


@pytest.fixture
def flown(study, tmp_path):
    """A study's folder with flows, and what its run.json tells."""
    folder = tmp_path / "flown"
    shutil.copytree(study, folder, ignore=shutil.ignore_patterns("app.json"))
    told = json.loads((folder / "run.json").read_text())
    told["settings"]["flow"] = asdict(FlowSettings(inflow_mL_s=1.0))
    (folder / "run.json").write_text(json.dumps(told))
    for name in ("bare", "silk"):
        keep_flow(folder, told["input"]["sha256"], settings_of(told["settings"]), name)
    return folder, told


def test_a_study_of_two_implants_opens_with_its_flow_and_numbers(flown, tmp_path):
    folder, told = flown
    told["settings"]["treatments"] = [asdict(read_treatment("silk + silk@-4"))]
    (folder / "run.json").write_text(json.dumps(told))
    metrics = report_case.metrics()
    silk = metrics["treatments"].pop("silk")
    del metrics["treatments"]["enterprise"]
    measures = [{"device": "Silk", "size": f"4.00 x {length} mm"} for length in (15, 20)]
    silk["implants"] = dict(zip(("silk", "silk_2"), measures, strict=True))
    metrics["treatments"]["silk+silk_2"] = silk
    ranked = {"treatment": "silk+silk_2", "score": 0.75, "is_suitable": True, "reason": "the flow"}
    metrics["ranking"] = [ranked]
    (folder / "metrics.json").write_text(json.dumps(metrics))
    for name in ("bare", "silk+silk_2"):
        keep_flow(folder, told["input"]["sha256"], settings_of(told["settings"]), name)
    with app_case.served(tmp_path / "cases", folder) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        view = client.get(case).json()
        assert set(view["steps"].values()) == {"done"}
        (treatment,) = view["choices"]["treatments"]
        assert [implant["inside"] for implant in treatment["implants"]] == [[], ["silk"]]
        assert treatment["implants"][1]["placing"]["shift_mm"] == -4.0
        assert app_case.opened(client.get(f"{case}/flow"))[0]["panes"] == ["bare", "silk+silk_2"]
        moved, _ = app_case.opened(client.get(f"{case}/flow", params={"cut_mm": 0.5}))
        assert [(layer["id"], layer["pane"]) for layer in moved["layers"]] == [
            ("slice", name) for name in moved["panes"]
        ]
        numbers = client.get(f"{case}/numbers").json()
        (flow,) = numbers["flow"]
        assert numbers["ranking"] == [ranked]
        assert (flow["names"], flow["devices"]) == (["silk+silk_2"], ["Silk 4.00 x 15 mm + Silk 4.00 x 20 mm"])


def test_a_case_of_another_version_is_refused_in_a_sentence_and_left_as_it_is(tmp_path):
    state = tmp_path / "old" / "app.json"
    state.parent.mkdir()
    state.write_text('{"name": "old", "choices": {"devices": [{"name": "silk"}]}}')
    before = state.read_bytes()
    with pytest.raises(ReadError, match=r"from another version of vstent: open the scan of the case again\.$"):
        Workspace(Cases(tmp_path / "cases")).open(tmp_path / "old")
    assert state.read_bytes() == before
    assert [path.name for path in state.parent.iterdir()] == ["app.json"]


def test_each_flow_is_shown_as_it_ends(flown, tmp_path):
    folder, _ = flown
    case = Workspace(Cases(tmp_path / "cases"))
    case.open(folder)
    state = case.cases.get(case.opened).state
    whole = kept_flows(folder)
    assert list(shown_flows(folder, state)) == ["bare", "silk"]
    whole["silk"].unlink()
    assert shown_flows(folder, state) == {}  # of a finished study all flows are there
    at_work = state.model_copy(update={"job": "flow"})
    assert list(shown_flows(folder, at_work)) == ["bare"]
    whole["bare"].unlink()
    assert shown_flows(folder, at_work) == {}


def test_flows_of_other_settings_are_not_taken_for_those_of_the_results(flown, tmp_path):
    folder, told = flown
    with app_case.served(tmp_path / "cases", folder) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        view = client.get(case).json()
        assert view["has_flow"]
        assert set(view["steps"].values()) == {"done"}
        # Studies with other inflows were stopped after their first flow: after three, that of the results is gone.
        settings = settings_of(told["settings"])
        for inflow_mL_s in (3.0, 4.0, 5.0):
            assert client.get(case).json()["has_flow"]
            other = replace(settings, flow=replace(settings.flow, inflow_mL_s=inflow_mL_s))
            keep_flow(folder, told["input"]["sha256"], other, "bare")
        view = client.get(case).json()
        assert not view["has_flow"]
        assert (view["steps"]["flow"], view["steps"]["report"]) == ("stale", "stale")
        (listed,) = client.get("/api/cases").json()["cases"]
        assert (listed["done"], listed["kept"]) == (list(STEPS[:5]), list(STEPS))
        assert "Run the step Flow" in client.get(f"{case}/flow").json()["detail"]
        (folder / "report.html").unlink()
        steps = client.get(case).json()["steps"]
        assert (steps["flow"], steps["report"]) == ("todo", "todo")
    (folder / "app.json").unlink()
    with app_case.served(tmp_path / "others", folder) as client:
        (listed,) = client.get("/api/cases").json()["cases"]
        assert listed["done"] == list(STEPS[:5])


def test_going_back_to_former_settings_shows_their_stored_flows(flown, tmp_path):
    folder, told = flown
    settings = settings_of(told["settings"])
    other = replace(settings, flow=replace(settings.flow, inflow_mL_s=3.0))
    for name in ("bare", "silk"):
        keep_flow(folder, told["input"]["sha256"], other, name)
    written = {path: path.stat().st_mtime_ns for path in (folder / CACHE).glob("flow *")}
    with app_case.served(tmp_path / "cases", folder) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        flow = client.get(case).json()["choices"]["flow"]
        assert choose(client, case, flow=flow | {"inflow_mL_s": 2.0}).json()["job"] is None  # never computed
        assert choose(client, case, flow=flow | {"inflow_mL_s": 3.0}).json()["job"]["kind"] == "flow"
        client.delete(f"{case}/jobs")
    assert {path: path.stat().st_mtime_ns for path in (folder / CACHE).glob("flow *")} == written


def test_what_cannot_be_chosen_on_the_page_stays_as_the_study_had_it(flown, tmp_path):
    folder, told = flown
    pulse = Waveform(0.8, (0.2,), (0.1,))
    blood = Blood(1050.0, 0.0035, CarreauYasuda())
    flow = FlowSettings(inflow_mL_s=1.0, blood=blood, waveform=pulse, numerics=Numerics(refine=("sac",)))
    given = replace(settings_of(told["settings"]), flow=flow, uncertainty=Ranges(16, landing_mm=2.0))
    told["settings"] = asdict(given)
    (folder / "run.json").write_text(json.dumps(told))
    with app_case.served(tmp_path / "cases", folder) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        view = client.get(case).json()
        unseen = {"flow blood viscosity 0.00350\u202fPa·s", "flow blood thinning", "flow numerics refine"}
        assert unseen < set(view["unseen"])
        assert client.get("/api/waveform", params={"case_id": case.rpartition("/")[2]}).json()["time_s"][-1] == 0.8
        choose(client, case, flow=view["choices"]["flow"] | {"inflow_mL_s": 2.0}, treatments=[alone("enterprise")])
        asked = load("flown", folder).state.settings()
    assert asdict(asked.flow) == asdict(replace(flow, inflow_mL_s=2.0))
    assert asdict(asked.uncertainty) == asdict(given.uncertainty)
    assert asked.treatments == (with_device("enterprise"),)


def test_a_setting_that_the_page_does_not_take_is_named(flown, tmp_path):
    folder, told = flown
    told["settings"]["flow"]["numerics"]["cell_size_mm"] = 0.001
    (folder / "run.json").write_text(json.dumps(told))
    with pytest.raises(ReadError, match=r"grid spacing: 0.001 mm is out of range.*vstent run"):
        Workspace(Cases(tmp_path / "cases")).open(folder)


def test_a_folder_whose_study_was_run_again_at_the_shell_shows_no_other_results_as_done(flown, tmp_path):
    folder, told = flown
    with app_case.served(tmp_path / "cases", folder) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        told["settings"]["flow"]["inflow_mL_s"] = 3.0
        (folder / "run.json").write_text(json.dumps(told))
        for name in ("bare", "silk"):
            keep_flow(folder, told["input"]["sha256"], settings_of(told["settings"]), name)
        view = client.get(case).json()
    assert view["has_flow"]
    assert (view["steps"]["flow"], view["steps"]["report"]) == ("todo", "todo")


def test_flows_of_a_study_before_one_without_flow_are_not_its(flown):
    folder, told = flown
    assert [path.name.partition("-")[0] for path in kept_flows(folder).values()] == ["flow bare", "flow silk"]
    told["settings"]["flow"] = None
    (folder / "run.json").write_text(json.dumps(told))
    assert kept_flows(folder) == {}


def test_slices_hold_the_scans_voxels_and_the_live_surface_is_its_wall(tmp_path):
    rng = np.random.default_rng(3)
    voxels = rng.normal(100, 5, (40, 36, 30))
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in voxels.shape), indexing="ij"), axis=-1)
    voxels[np.linalg.norm(grid - [20, 18, 15], axis=-1) < 9] = 1000
    write_dicom(vstent_image(voxels), tmp_path / "scan")
    with app_case.served(tmp_path / "cases", tmp_path / "scan") as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        app_case.until(lambda: client.get(case).json()["has_input"])
        image = read_image(tmp_path / "scan")
        told, data = app_case.opened(client.get(f"{case}/image/slice", params={"axis": 2, "index": 15}))
        shown = app_case.numbers(told["values"], data).reshape(told["height"], told["width"])
        np.testing.assert_allclose(shown, image.voxels[:, :, 15].T, atol=0.02)
        assert client.get(f"{case}/image/slice", params={"axis": 2, "index": 30}).status_code == 422
        told, data = app_case.opened(client.get(f"{case}/image/surface", params={"threshold": 550}))
        points = app_case.numbers(told["layers"][0]["points"], data)
        radius = np.linalg.norm(points - image.to_mm(np.array([[20, 18, 15]])), axis=1)
        assert radius.mean() == pytest.approx(8.75 * 0.4, rel=0.03)


def vstent_image(voxels):
    from vstent.geometry.image import Image

    return Image(voxels.astype(np.int16), np.diag([0.4, 0.4, 0.4, 1.0]), "XA")


def test_a_cut_lies_in_one_plane_and_has_the_flows_speed_at_a_moment_or_in_the_mean():
    anatomy, mean = report_case.anatomy(), report_case.field(1.0)
    fast = Phase(
        0.25,
        2 * mean.inlets_mL_s,
        2 * mean.outlets_mL_s,
        (2 * mean.velocity_m_s,),
        (mean.pressure_Pa,),
        3 * mean.wall_shear_stress_Pa,
    )
    pulsing = replace(mean, phases=(fast,))
    layers = [cuts.cut("bare", field, anatomy) for field in (mean, pulsing.at_phase(pulsing.phases[0]))]
    points = layers[0].surface.vertices_mm
    assert np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2] < 1e-9
    # In the bend's plane the speed is Poiseuille's: its largest, on the axis, is 0.5 m/s.
    off = np.hypot(points[:, 0], points[:, 2]) - report_case.BEND_MM
    on_axis = (np.abs(off) < 0.1) & (points[:, 2] > 3) & (np.abs(points[:, 1]) < 0.1)
    assert on_axis.sum() > 10
    np.testing.assert_allclose(layers[0].values[on_axis], 0.5, rtol=0.08)
    np.testing.assert_allclose(layers[1].values, 2 * layers[0].values, rtol=1e-5)
    np.testing.assert_allclose(pulsing.at_phase(pulsing.phases[0]).shear_Pa, 3 * mean.shear_Pa, rtol=1e-5)


def test_the_interface_is_described_and_its_page_needs_no_network(client):
    api = client.get("/api/openapi.json").json()
    assert "/api/cases/{case_id}/choices" in api["paths"]
    assert all(verb["summary"] for verbs in api["paths"].values() for verb in verbs.values())
    for path in ("/api/docs", "/assets/docs.js", "/", "/assets/app.css"):
        assert "https://" not in client.get(path).text
    flow = api["components"]["schemas"]["FlowChoice"]["properties"]  # the page takes its lists and limits from here
    limits = stated(FlowSettings)["numerics.cell_size_mm"].limits
    assert (flow["cell_size_mm"]["minimum"], flow["cell_size_mm"]["maximum"]) == (limits.low, limits.high)
    assert flow["inflow_mL_s"]["exclusiveMinimum"] == 0.0
    assert flow["outlets"]["enum"] == list(get_args(Outlets))


def test_uncertainty_is_told_in_the_order_of_the_treatments_with_its_causes():
    def varied(low, high):
        ends = {"mean": 0.5 * (low + high), "low": low, "high": high}
        shares = {"landing_fraction": 0.2, "device_fraction": 0.7, "rest_fraction": 0.1}
        ranges = {"threshold_mm": 0.0, "landing_mm": 1.0, "device_mm": 0.1, "inflow_fraction": 0.2}
        return {
            "samples_count": 16,
            "failed_count": 1,
            "ranges": ranges,
            "intervals": {"deployed_length_mm": ends},
            "shares": {"deployed_length_mm": shares},
        }

    metrics = {
        "treatments": {"enterprise": {"uncertainty": varied(12.0, 14.0)}, "silk": {"uncertainty": varied(15.0, 18.0)}}
    }
    silk, enterprise = sheets.uncertainty(metrics, {"silk": "Silk 4 x 15 mm", "enterprise": "Enterprise"})
    assert (silk["title"], enterprise["title"]) == ("Silk 4 x 15 mm", "Enterprise")
    (row,) = silk["rows"]
    assert [row[key].replace("\u202f", " ") for key in ("mean", "low", "high")] == ["16.5 mm", "15.0 mm", "18.0 mm"]
    assert [cause for cause, _ in row["shares"]] == ["manufacturing tolerance", "landing", "interplay and chance"]
    assert "16 deployments, of which 1 did not fit" in silk["words"]
    assert sheets.uncertainty({"treatments": {"silk": {}}}, {"silk": "Silk"}) == []


def test_the_first_page_waits_for_nothing_that_only_results_need():
    code = (
        "import sys; from vstent.app import server; [server.asset(name) for name in server.ASSETS]; "
        "print(sorted({'vstent.reporting', 'numba', 'scipy', 'vtkmodules', 'matplotlib'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_the_page_was_built_from_the_sources_beside_it():
    viewer = Path(__file__).resolve().parents[2] / "viewer"
    sources = [source for folder in ("src", "app") for source in sorted((viewer / folder).iterdir())]
    built = files("vstent.app").joinpath("assets", "app.js").read_text(encoding="utf-8")
    digest = hashlib.sha256(
        b"".join(path.read_bytes() for path in [*sources, viewer / "package-lock.json"])
    ).hexdigest()
    assert f"sources {digest} */" in built[:300], "run `npm ci && npm run build` in viewer/"
    style = files("vstent.app").joinpath("assets", "app.css").read_text(encoding="utf-8")
    assert style == (viewer / "app" / "app.css").read_text(encoding="utf-8")


@pytest.mark.validation
def test_with_flow_all_ways_in_agree_too(tmp_path):
    path = tmp_path / "phantom.stl"
    write_stl(path, phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.35))
    with app_case.served(tmp_path / "cases", path) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        app_case.wait(client, case.rpartition("/")[2])
        assert choose(client, case, treatments=[SILK], flow={"cell_size_mm": 0.35}).status_code == 200
        client.post(f"{case}/jobs/flow")
        app_case.wait(client, case.rpartition("/")[2], 1200)
        by_rest = client.get(f"{case}/files/metrics.json").json()
    assert main(["run", str(path), "--out", str(tmp_path / "cli"), "--device", "silk", "--grid-spacing", "0.35"]) == 0
    assert by_rest == json.loads((tmp_path / "cli" / "metrics.json").read_text())


FIRST_REQUESTS = """
import socket, sys, threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import get_args
import httpx, uvicorn
from vstent.app.cases import Cases
from vstent.app.workspace import Workspace
from vstent.app.server import create

importing = set()
def heard(event, values):
    if event == "import" and values[0].startswith("vstent."):
        importing.add(threading.get_ident())
listener = socket.create_server(("127.0.0.1", 0))
host = f"127.0.0.1:{listener.getsockname()[1]}"
guard = create(Workspace(Cases(Path(sys.argv[1]))), token="t", hosts=(host,))
server = uvicorn.Server(uvicorn.Config(guard, log_level="error"))
sys.addaudithook(heard)
thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
thread.start()
def asked(path):
    return httpx.get(f"http://{host}{path}", headers={"authorization": "Bearer t"}, timeout=60).status_code
with ThreadPoolExecutor(9) as pool:
    print(set(pool.map(asked, 3 * ["/api/waveform", "/api/catalogue", "/api/cases"])), len(importing))
server.should_exit = True
thread.join()
"""


def test_the_first_requests_wait_for_one_thread_that_loads(tmp_path):
    """Threads that import a package and a module of it at once may get a half of it: a page then had answers of 500."""
    given = [sys.executable, "-c", FIRST_REQUESTS, str(tmp_path)]
    found = subprocess.run(given, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "{200} 1"


def keep_contrast(folder):
    """Keep contrast with every flow of a study, as an angiogram does."""
    told = {}
    for name, path in kept_flows(folder).items():
        told[name] = {"flow": path.stem.removeprefix(f"flow {name}-"), "measures": {}}
        carrier = load_data(path, FlowField)
        levels = np.full((3, len(carrier.centers_mm)), 200, np.uint8)
        block = np.arange(len(carrier.centers_mm))
        history = History(carrier.centers_mm, carrier.finest.cell_size_mm, block, np.arange(3) / 15, levels, 300.0)
        key = angiogram_key(stored.Key(*told[name]["flow"].split("-")), AngiogramSettings())
        save_data(stored.Store(path.parent).path(f"contrast {name}", key), history)
    (folder / "angiogram").mkdir()
    (folder / "angiogram" / NUMBERS).write_text(json.dumps({"flows": told}))


def test_films_of_stored_contrast_come_along_any_direction(flown, tmp_path):
    folder, _ = flown
    with app_case.served(tmp_path / "cases", folder) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        assert not client.get(case).json()["has_angiogram"]
        assert "Compute it in the step Flow" in client.get(f"{case}/angiogram").json()["detail"]
        keep_contrast(folder)
        assert client.get(case).json()["has_angiogram"]
        told, data = app_case.opened(client.get(f"{case}/angiogram", params={"view": "RAO 20 CAU 5"}))
        assert told["view"] == "RAO 20 CAU 5"
        assert [pane["id"] for pane in told["panes"]] == ["bare", "silk"]
        assert len(data) >= 2 * 3 * told["rows"] * told["columns"]
        quick = client.get(f"{case}/angiogram", params={"view": "RAO 20", "moment": 1, "wires": True})
        assert len(quick.content) < len(data)
        assert app_case.opened(client.get(f"{case}/angiogram"))[0]["view"]  # the working projection
        refused = client.get(f"{case}/angiogram", params={"view": "up"})
        assert (refused.status_code, "not a C-arm direction" in refused.json()["detail"]) == (422, True)


def test_an_angiogram_needs_a_flow_that_is_up_to_date(client, case):
    refused = client.post(f"{case}/jobs/angiogram")
    assert refused.status_code == 422
    assert "Run the step Flow" in refused.json()["detail"]
