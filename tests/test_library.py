"""vstent as a library for others: its names, their types, plug-ins, threads."""

import inspect
import re
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from faults import artery

import vstent
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.deploy import deploy
from vstent.devices import catalogue
from vstent.devices.stent import Deployment, Landing
from vstent.errors import DeviceError, FlowError, PluginError
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import check_engine, foretell_cost, simulate_case
from vstent.geometry.vessel import Anatomy, Vessel

API = Path(__file__).parents[1] / "docs" / "reference" / "api.rst"
NAMES = (
    "AnatomySettings",
    "AngiogramSettings",
    "FlowSettings",
    "Image",
    "Implant",
    "InputSettings",
    "Landing",
    "Numerics",
    "Placing",
    "Settings",
    "Treatment",
    "angiogram",
    "catalogue",
    "compare",
    "deploy",
    "find_design",
    "find_size",
    "indices",
    "measure",
    "morphology",
    "on_path",
    "ostium",
    "rank",
    "read_image",
    "read_treatment",
    "read_vessel",
    "report",
    "restore",
    "run",
    "segment",
    "simulate",
    "straighten",
    "struts",
    "trace",
    "trim",
)
"""What others may rely on; a name goes only with a line in the changelog."""


def test_the_public_names_are_these() -> None:
    assert tuple(vstent.__all__) == NAMES
    assert set(dir(vstent)) > {*NAMES, "__doc__"}
    for name in NAMES:
        found = getattr(vstent, name)
        assert callable(found)
        assert found.__name__ == name
        assert found.__doc__


def test_the_reference_documents_every_public_name() -> None:
    documented = re.findall(r"auto(?:function|class):: ([\w.]+)", API.read_text())
    assert {f"{one.__module__}.{one.__name__}" for one in map(partial(getattr, vstent), NAMES)} <= set(documented)


def test_every_public_name_says_its_types() -> None:
    assert resources.files("vstent").joinpath("py.typed").is_file()
    for name in NAMES:
        signature = inspect.signature(inspect.unwrap(getattr(vstent, name)))
        assert signature.return_annotation is not inspect.Signature.empty, name
        assert all(p.annotation is not inspect.Parameter.empty for p in signature.parameters.values()), name


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    return restore(trim(trace(Vessel(artery()))))


PLUGIN = '''
from vstent.deployment.wall import TreeWall
from vstent.flow.engines import AbstractEngine


def devices():
    return """
[[device]]
key = "plugged"
name = "Plugged in"
maker = "a test"
kind = "braid"
wires = [{ count = { value = 48, low = 48, high = 48 }, diameter_um = { value = 30, low = 28, high = 32 }, \\
source = "none", confidence = "estimated", reason = "none" }]
braid_angle_rad = { value = 1.15, low = 1, high = 1.2, source = "none", confidence = "estimated", reason = "why" }
free_diameter_margin_mm = { value = 0.2, low = 0, high = 0.3, source = "none", confidence = "derived", reason = "why" }
sizes = [{ diameters_mm = [4.0], lengths_mm = [15], length_tolerance_mm = 1, \\
source = "none", confidence = "estimated", reason = "none" }]
"""


class Still(AbstractEngine):
    """An engine in which nothing moves, and that writes a file."""

    def init(self, case, start):
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "notes").write_text("still")
        return case

    def step(self, state):
        return state

    def terminate(self, state):
        return 0.0

    def max_checks(self, state):
        return 1

    def result(self, state, outcome):
        return ("still", self.cell_size_mm, outcome.is_converged)

    def save(self, state):
        return {}

    def resume(self, case, saved):
        return case

    def trouble(self, state):
        return "none"


class Half(AbstractEngine):
    def init(self, case, start):
        return case

'''


@pytest.fixture
def distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A distribution, tiny but whole, that plugs in a device and an engine."""
    (tmp_path / "tiny_plugin.py").write_text(PLUGIN)
    info = tmp_path / "tiny_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tiny-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[vstent.devices]\ntiny = tiny_plugin:devices\n\n"
        "[vstent.engines]\nstill = tiny_plugin:Still\nhalf = tiny_plugin:Half\n"
        "other = tiny_plugin:devices\nmissing = tiny_plugin:Nothing\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "tiny_plugin", raising=False)
    catalogue.catalogue.cache_clear()
    yield tmp_path
    monkeypatch.undo()
    catalogue.catalogue.cache_clear()


@pytest.mark.usefixtures("distribution")
def test_a_device_is_plugged_in() -> None:
    plugged = vstent.find_design("plugged")
    assert (plugged.maker, plugged.n_wires, plugged.facts[0].confidence) == ("a test", 48, "estimated")
    assert set(catalogue.catalogue()) > {"silk", "enterprise"}


def test_a_device_that_is_plugged_in_twice_is_refused(distribution: Path) -> None:
    text = (distribution / "tiny_plugin.py").read_text().replace('key = "plugged"', 'key = "silk"')
    (distribution / "tiny_plugin.py").write_text(text)
    with pytest.raises(
        DeviceError, match=r"plug-in tiny \(tiny_plugin:devices\) names a device that the catalogue already has, silk"
    ):
        vstent.catalogue()


@pytest.mark.usefixtures("distribution")
def test_a_flow_engine_is_plugged_in(anatomy: Anatomy, tmp_path: Path) -> None:
    case = flow_case(anatomy, (), FlowSettings(numerics=Numerics(engine="still", cell_size_mm=3.0)))
    assert simulate_case(case) == ("still", 3.0, True)
    assert simulate_case(case, folder=tmp_path / "own") == ("still", 3.0, True)
    assert (tmp_path / "own" / "notes").read_text() == "still"
    assert "cannot be estimated in advance" in foretell_cost(case)


@pytest.mark.usefixtures("distribution")
def test_plugins_that_are_not_there_are_named(anatomy: Anatomy) -> None:
    with pytest.raises(
        PluginError,
        match=r"no 'stil' in vstent.engines: choose one of lattice_boltzmann, openfoam, half, missing, other, still",
    ):
        simulate_case(flow_case(anatomy, (), FlowSettings(numerics=Numerics(engine="stil", cell_size_mm=3.0))))
    with pytest.raises(PluginError, match=r"missing of vstent.engines cannot be loaded"):
        simulate_case(flow_case(anatomy, (), FlowSettings(numerics=Numerics(engine="missing", cell_size_mm=3.0))))


@pytest.mark.usefixtures("distribution")
@pytest.mark.parametrize(
    ("name", "said"), [("half", "lacks max_checks, result, resume, save"), ("other", "lacks AbstractEngine")]
)
def test_an_incomplete_engine_is_refused_before_anything_is_computed(name: str, said: str) -> None:
    with pytest.raises(PluginError, match=f"The engine {name} is incomplete: it {said}"):
        check_engine(FlowSettings(numerics=Numerics(engine=name)))


def test_without_openfoam_its_engine_is_refused_before_anything_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vstent.flow.openfoam.program.find", lambda: pytest.fail("it was looked for"))
    check_engine(FlowSettings(numerics=Numerics(engine="openfoam")), runs_here=False)
    monkeypatch.undo()
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    with pytest.raises(FlowError, match="OpenFOAM was not found"):
        check_engine(FlowSettings(numerics=Numerics(engine="openfoam")))


def test_two_threads_deploy_as_one_does(anatomy: Anatomy) -> None:
    jobs = [(name, shift_mm) for shift_mm in (-1.5, 0.0, 1.5) for name in ("silk", "enterprise")]
    gate = threading.Barrier(2)
    middle_mm = float(deploy(vstent.find_design("silk"), anatomy).stent.row_abscissa_mm.mean())

    def work(job: tuple[str, float]) -> Deployment:
        return deploy(vstent.find_design(job[0]), anatomy, landing=Landing(middle_mm + job[1]))

    def together(job: tuple[str, float]) -> Deployment:
        gate.wait(60)  # both begin at once, every time
        return work(job)

    with ThreadPoolExecutor(2) as pool:
        at_once = list(pool.map(together, jobs))
    for job, found in zip(jobs, at_once, strict=True):
        alone = work(job)
        for name in ("nodes_mm", "wire_points_mm", "row_abscissa_mm"):
            np.testing.assert_array_equal(getattr(found.stent, name), getattr(alone.stent, name))
        np.testing.assert_array_equal(found.wall_gap_mm, alone.wall_gap_mm)


def test_type_checkers_see_what_is_loaded_late() -> None:
    source = resources.files("vstent").joinpath("__init__.py").read_text()
    assert sorted(re.findall(r"(\w+) as \1\b", source)) == sorted(NAMES)
