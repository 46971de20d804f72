"""A study in which the artery yields: metrics, files, notes, resumption, and the rigid artery as before."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults import artery

from vstent.devices.treatment import read_treatment
from vstent.errors import InputError
from vstent.flow.settings import FlowSettings, Numerics
from vstent.io.writers import write_stl
from vstent.plan.ranges import Ranges
from vstent.reporting.quality import qualities
from vstent.reporting.scene import scene_of
from vstent.reporting.uncertainty import uncertainty_of
from vstent.study.pipeline import run
from vstent.study.settings import Settings

FLOW = FlowSettings(numerics=Numerics(cell_size_mm=0.5, max_steps=400))


def settings(*treatments: str, straightening: str, flow: FlowSettings | None = None) -> Settings:
    """Settings of a study."""
    return Settings(treatments=tuple(map(read_treatment, treatments)), flow=flow, straightening=straightening)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's artery as a file."""
    path = tmp_path_factory.mktemp("source") / "artery.stl"
    write_stl(path, artery())
    return path


def test_the_rigid_artery_stays_as_it_is(source: Path, tmp_path: Path) -> None:
    rigid = run(source, tmp_path / "rigid", settings("enterprise", straightening="off"))
    yielded = run(source, tmp_path / "yielded", settings("enterprise", straightening="immediate"))
    added = yielded.metrics["treatments"]["enterprise"].pop("straightening")
    assert rigid.metrics == yielded.metrics
    assert added["straightened_low_rad"] < added["straightened_rad"] < added["straightened_high_rad"]
    (note,) = [note for note in yielded.notes if note.startswith("Straightening, enterprise: ")]
    is_unsure = added["straightened_high_rad"] - added["straightened_low_rad"] > added["straightened_rad"]
    assert ("The band is wider than the effect." in note) == is_unsure
    folder = tmp_path / "yielded" / "treatments" / "enterprise" / "straightened"
    assert {file.name for file in folder.iterdir()} >= {"vessel.vtp", "sac.vtp", "landing_surface.vtp"}
    assert not (tmp_path / "rigid" / "treatments" / "enterprise" / "straightened").exists()
    stages: list[str] = []
    again = settings("enterprise", straightening="immediate")
    run(source, tmp_path / "yielded", again, lambda now: stages.append(f"{now.stage} {now.detail}"))
    assert "straighten enterprise already done" in stages
    with pytest.raises(InputError, match="holds results with other straightening"):
        run(source, tmp_path / "yielded", replace(again, straightening="six_months"))


def test_a_treatment_at_a_fork_or_in_a_sac_does_not_stop_the_others(source: Path, tmp_path: Path) -> None:
    """Coils in the sac follow it; a sac filled by them alone straightens nothing."""
    found = run(source, tmp_path, settings("enterprise + coils(4%)", "coils(4%)", straightening="4deg"))
    treatments = found.metrics["treatments"]
    assert "straightening" in treatments["enterprise+coils"]
    assert "straightening" not in treatments["coils"]
    assert not found.failures


def test_both_effects_have_their_flow(source: Path, tmp_path: Path) -> None:
    found = run(source, tmp_path, settings("enterprise", straightening="12deg", flow=FLOW))
    treatment = found.metrics["treatments"]["enterprise"]
    alone, both = treatment["straightening"]["bare"]["change"], treatment["straightening"]["change"]
    ratio = "mean_sac_velocity_m_s_ratio"
    assert len({treatment["change"][ratio], alone[ratio], both[ratio]}) == 3
    for part in (treatment["straightening"], treatment["straightening"]["bare"]):
        assert part["quality"]["grade"] == treatment["quality"]["grade"] == "not usable"  # of so coarse a grid
        assert part["quality"]["cells_across_parent_count"] == pytest.approx(7.5, abs=0.5)
    titles = [one.title for one in qualities(found.metrics, {"enterprise": "Enterprise"})]
    assert "Grid and convergence with Enterprise in the straightened artery" in titles
    assert "not usable: use a finer grid" in found.notes[0]
    assert set(found.fields) == {"bare", "enterprise"}
    scene = scene_of(found.anatomy, found.implants, found.shown, found.yielded)
    for pane, anatomy in (("bare", found.anatomy), ("enterprise", found.yielded["enterprise"].anatomy)):
        (lumen,) = scene.pick(("lumen",), pane)
        assert anatomy.vessel.lumen.closest(lumen.vertices_mm)[1].max() < 0.02
        (lines,) = scene.pick(("streamlines",), pane)
        assert anatomy.vessel.lumen.closed.signed_distance(lines.vertices_mm).max() < 0.3
    assert [title for _, title in scene.panes][1].endswith(", artery straightened")
    (note,) = [note for note in found.notes if note.startswith("Straightening, enterprise: ")]
    assert note.endswith(f" {alone[ratio] - 1:+.0%} by straightening, {both[ratio] - 1:+.0%} by both.")
    for part in ("flow", "straightened/flow", "straightened/bare/flow"):
        assert (tmp_path / "treatments" / "enterprise" / part / "field.vtu").is_file()
    assert json.loads((tmp_path / "metrics.json").read_text())["treatments"]["enterprise"]["straightening"]["bare"]


def test_an_uncertainty_study_gives_angle_radius_and_velocity_their_bands(source: Path, tmp_path: Path) -> None:
    study = settings("enterprise", straightening="six_months", flow=FLOW)
    found = run(source, tmp_path, replace(study, uncertainty=Ranges(2, flow_samples=2)))
    treatment = found.metrics["treatments"]["enterprise"]
    varied = treatment["uncertainty"]["intervals"]
    low, high = (np.degrees(varied["straightened_rad"][end]) for end in ("low", "high"))
    (note,) = [note for note in found.notes if note.startswith("Straightening, enterprise: ")]
    is_unsure = high - low > np.degrees(treatment["straightening"]["straightened_rad"])
    assert note.startswith("Straightening, enterprise: The band is wider than the effect. ") == is_unsure
    assert f" degrees ({low:.0f} to {high:.0f}), " in note
    radius = varied["bend_radius_after_mm"]
    assert f" ({radius['low']:.1f} to {radius['high']:.1f}) mm, " in note
    for effect, said in (("", "devices"), ("straightened_bare_", "straightening"), ("straightened_", "both")):
        band = varied[f"{effect}mean_sac_velocity_m_s_ratio"]
        assert band["low"] < band["high"]
        assert f"% ({band['low'] - 1:+.0%} to {band['high'] - 1:+.0%}) by " in note.partition(f" {said}")[0] + " by "
    (told,) = uncertainty_of(found.metrics, {})
    assert "the stiffness of the device relative to wall and bed within its range" in told.words
    assert "Mean sac velocity, after / before, straightened, without device" in [row.name for row in told.rows]
