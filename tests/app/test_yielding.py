"""The artery that yields on the page: redrawn with every drag, and shown with the flow in it."""

import app_case
import numpy as np
import pytest
from faults import artery

from vstent.app.yielding import Yielding
from vstent.deployment.deploy import deploy
from vstent.deployment.straightening import Straightening, straighten
from vstent.devices.treatment import read_treatment
from vstent.flow.settings import FlowSettings, Numerics
from vstent.geometry.vessel import Anatomy
from vstent.io.archive import load_data
from vstent.io.writers import write_stl
from vstent.study.folder import CACHE
from vstent.study.pipeline import run
from vstent.study.settings import Settings

WANTED = {
    "treatment": {"name": "enterprise", "implants": [{"id": "enterprise", "device": "enterprise"}]},
    "implant": "enterprise",
}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study of an Enterprise in the demo's artery, which opens by 8 degrees, with flows."""
    folder = tmp_path_factory.mktemp("study")
    write_stl(folder / "artery.stl", artery())
    flow = FlowSettings(numerics=Numerics(cell_size_mm=0.5, max_steps=300))
    study = Settings(treatments=(read_treatment("enterprise"),), flow=flow, straightening="8deg")
    run(folder / "artery.stl", folder / "case", study)
    return folder / "case"


@pytest.fixture(scope="module")
def found(study):
    """The artery as scanned, and the one that has yielded."""
    (scanned,), (yielded,) = ((study / CACHE).glob(f"{name}-*.npz") for name in ("anatomy", "straighten enterprise"))
    return load_data(scanned, Anatomy), load_data(yielded, Straightening)


def layers_of(answer, pane):
    """The points of the layers of a pane, by their name, and what the message states."""
    told, data = app_case.opened(answer)
    layers = {
        one["id"]: app_case.numbers(one.get("points") or one["frames"], data)
        for one in told["layers"]
        if one["pane"] == pane
    }
    return layers, told


def test_a_drag_redraws_the_artery_and_the_device_in_it(study, found, tmp_path):
    scanned, yielded = found
    with app_case.served(tmp_path, study) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        for route, names in (("sketch", set()), ("deployment", {"contour"})):
            layers, told = layers_of(client.post(f"{case}/{route}", json=WANTED), "enterprise")
            assert set(layers) == {"lumen", "neck", "axis", "wires"} | names
            assert "The artery opens by 8" in told["straightening"]
            axis_mm = np.reshape(told["moved_axis"], (-1, 3))
            true_mm, before_mm = yielded.anatomy.parent.axis.points_mm, scanned.parent.axis.points_mm
            ways_mm = np.linalg.norm(true_mm - before_mm, axis=1)
            assert ways_mm.max() > 0.3
            assert (
                np.linalg.norm(axis_mm - true_mm, axis=1).max() < 0.3 * ways_mm.max()
            )  # the device is not deployed again
            wall = yielded.anatomy.vessel.lumen
            off_mm = wall.closest(layers["lumen"])[1]
            assert np.quantile(off_mm, 0.99) < 0.3 * ways_mm.max()
            assert scanned.vessel.lumen.closest(layers["lumen"])[1].max() > 0.8 * off_mm.max()
            assert wall.closed.signed_distance(layers["wires"]).max() < 0.4
        view = client.get(case).json()
        choices = view["choices"] | {"straightening": "off"}
        client.put(f"{case}/choices", json={"revision": view["revision"], "choices": choices}).raise_for_status()
        layers, told = layers_of(client.post(f"{case}/sketch", json=WANTED), "enterprise")
        assert set(layers) == {"wires"}
        assert "straightening" not in told


def test_a_treatment_is_shown_with_the_flow_in_the_artery_that_has_yielded(study, found, tmp_path):
    _, yielded = found
    with app_case.served(tmp_path, study) as client:
        case = f"/api/cases/{client.get('/api/cases').json()['opened']}"
        layers, told = layers_of(client.get(f"{case}/flow"), "enterprise")
        assert told["panes"] == ["bare", "enterprise"]
        assert {"lumen", "neck", "wires", "streamlines", "shear"} <= set(layers)
        wall = yielded.anatomy.vessel.lumen
        assert wall.closest(layers["lumen"])[1].max() < 0.05
        assert wall.closed.signed_distance(layers["streamlines"]).max() < 0.3  # within a cell
        bare, _ = layers_of(client.get(f"{case}/flow"), "bare")
        assert "lumen" not in bare


def test_what_does_not_yield_is_drawn_as_scanned(found):
    scanned, yielded = found
    (one,) = yielded.deployed
    drawn, told = Yielding(scanned).drawn("pane", [], [], "immediate")
    assert drawn == []
    assert told["straightening"].startswith("The artery is drawn as scanned. Nothing straightens the artery")
    _, told = Yielding(scanned).drawn("pane", [one.stent], [], "170deg")
    assert "opens this artery by at most" in told["straightening"]
    again = straighten(scanned, [deploy("enterprise", scanned)], "8deg")
    assert again.metrics() == yielded.metrics()
