"""`vstent compare-followup`: table, files and picture of the demo moved, bent and with noise; what it refuses."""

import io
import json

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from vstent.cli import main
from vstent.deployment.straightening import straighten
from vstent.geometry.surface import Surface
from vstent.io.writers import write_stl
from vstent.phantoms import demo_phantom, phantom_surface
from vstent.study.contrast import stents_of
from vstent.study.stages import deploy

TURN, SHIFT_MM = Rotation.from_rotvec([-0.6, 1.1, 0.4]).as_matrix(), np.array([-14.0, 25.0, 3.0])


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A case folder whose plan lets the artery open by 12 degrees, and the artery after the treatment in its frame."""
    folder = tmp_path_factory.mktemp("followup")
    write_stl(folder / "artery.stl", phantom_surface(demo_phantom(), edge_mm=0.3))
    command = ["run", str(folder / "artery.stl"), "--out", str(folder / "case"), "--units", "mm", "--no-flow"]
    assert (
        main([*command, "--treatment", "enterprise", "--treatment", "coils=coils(4%)", "--straightening", "12deg"]) == 0
    )
    anatomy, _ = stents_of(folder / "case", [])
    after = straighten(anatomy, [deploy("enterprise", anatomy)], "12deg").anatomy
    lumen = after.vessel.lumen
    noise_mm = 0.03 * np.random.default_rng(2).normal(size=lumen.vertices_mm.shape)
    moved = Surface(lumen.vertices_mm @ TURN.T + SHIFT_MM + noise_mm, lumen.faces)
    write_stl(folder / "after.stl", moved.closed)
    return folder, after


def test_the_command_writes_what_was_planned_beside_what_is_there(case, capsys):
    folder, after = case
    assert main(["compare-followup", str(folder / "case"), str(folder / "after.stl")]) == 0
    said = capsys.readouterr().out
    for words in ("planned", "after treatment", "Angle of the arms", "Radius of the sharpest bend", "Straightening"):
        assert words in said
    told = json.loads((folder / "case" / "followup.json").read_text())
    pose, planned, real = (told[part] for part in ("registration", "planned", "real"))
    assert f"residual of {pose['residual_mm']:.2f} mm" in said
    assert pose["residual_mm"] < 0.1
    turn = np.array(pose["turn"])
    assert np.degrees(Rotation.from_matrix(turn @ TURN.T).magnitude()) < 2.0
    # The map is that of the wall beside the device, the rest of the artery has bent.
    ends_mm = after.parent.axis.at(np.array([0.5, after.parent.axis.length_mm - 0.5]))
    found_mm = ends_mm @ turn.T + np.array(pose["shift_mm"])
    assert np.linalg.norm(found_mm - ends_mm @ TURN.T - SHIFT_MM, axis=1).max() < 1.2
    assert np.degrees(planned["straightened_rad"]) == pytest.approx(12.0, abs=0.6)
    assert np.degrees(real["straightened_rad"]) == pytest.approx(12.0, abs=2.0)
    assert np.degrees(real["arms_angle_rad"]) == pytest.approx(np.degrees(planned["arms_angle_rad"]), abs=2.0)
    assert real["bend_radius_mm"] == pytest.approx(planned["bend_radius_mm"], abs=0.4)
    assert set(real) == set(planned)  # a surface shows no wires
    image = imread(io.BytesIO((folder / "case" / "followup.png").read_bytes()))[..., :3]
    is_red = (image[..., 0] > image[..., 1] + 0.2) & (image[..., 1] < 0.7)
    is_gray = (np.ptp(image, axis=2) < 0.02) & (image[..., 0] > 0.5) & (image[..., 0] < 0.85)
    assert min(is_red.mean(), is_gray.mean()) > 0.004  # both walls are seen


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--treatment", "silk"], "has no treatment 'silk': choose one of enterprise, coils."),
        (["--treatment", "coils"], "coils has no device in the artery: only these are compared."),
        (["--metal", "2500"], "after.stl"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_a_sentence(case, words, said, capsys):
    folder, _ = case
    assert main(["compare-followup", str(folder / "case"), str(folder / "after.stl"), *words]) == 2
    assert said in capsys.readouterr().err


def test_a_folder_or_file_that_is_not_there_is_refused(case, tmp_path, capsys):
    folder, _ = case
    assert main(["compare-followup", str(tmp_path), str(folder / "after.stl")]) == 2
    assert "is not a case folder with a finished run" in capsys.readouterr().err
    assert main(["compare-followup", str(folder / "case"), str(tmp_path / "none.stl")]) == 2
    assert "none.stl" in capsys.readouterr().err
