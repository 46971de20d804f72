"""The scene: the views, the shared scales, thinning that keeps shapes, and packing that can be undone."""

import base64
import itertools
import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import report_case

from vstent.reporting.figures import plates
from vstent.reporting.packing import pack
from vstent.reporting.scene import LineLayer, flow_layers, round_up, scales_of, scene_of
from vstent.reporting.thinning import thin_frames, thin_lines, thin_surface


def test_profile_shows_the_artery_level_and_the_sac_above_it():
    right, up, toward = report_case.scene().view("profile").axes
    assert abs(right @ [1, 0, 0]) == pytest.approx(1, abs=1e-6)
    assert up == pytest.approx([0, 0, 1], abs=1e-6)
    assert np.cross(right, up) == pytest.approx(toward)


def test_every_view_is_a_rotation_and_holds_what_it_is_of():
    for view in report_case.scene().views:
        assert view.axes @ view.axes.T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(view.axes) == pytest.approx(1)
    neck = report_case.scene().view("neck")
    assert neck.axes[2] == pytest.approx([0, 0, 1], abs=1e-6)
    rim = report_case.anatomy().aneurysms[0].neck_mm
    seen = (rim - neck.center_mm) @ neck.axes.T
    assert np.linalg.norm(seen[:, :2], axis=1).max() == pytest.approx(neck.radius_mm / 1.3)


def test_frontal_and_lateral_follow_radiology():
    # LPS: x to the patient's left, y to the back, z to the head. From the front the patient's left is on the right.
    frontal, lateral = (report_case.scene().view(name).axes for name in ("frontal", "lateral"))
    assert frontal.tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert lateral.tolist() == [[0, 1, 0], [0, 0, 1], [1, 0, 0]]


def test_the_side_that_hides_less_is_chosen():
    from vstent.reporting.scene import views_of

    case = report_case.case()
    free = report_case.scene().view("profile").axes[2]
    screen = report_case.sphere(12.0 * free + [0, 0, 9.0], 5.0)
    vessel = SimpleNamespace(lumen=report_case.joined(case.anatomy.vessel.lumen, screen))
    hidden = SimpleNamespace(vessel=vessel, parent=case.anatomy.parent, aneurysms=case.anatomy.aneurysms)
    chosen = views_of(hidden, [one for found in case.implants.values() for one in found.values()])[0].axes
    assert chosen[2] == pytest.approx(-free)
    assert np.linalg.det(chosen) == pytest.approx(1)  # turned round, not mirrored


def test_one_scale_serves_every_pane():
    scene = report_case.scene()
    assert sorted(scale.id for scale in scene.scales) == ["coverage", "sac_shear", "shear", "speed", "wall_gap"]
    shear = [layer for layer in scene.layers if layer.id == "shear"]
    assert [layer.pane for layer in shear] == ["bare", "silk", "enterprise"]


def shear_scale(fields, anatomy):
    layers = [layer for pane, field in fields.items() for layer in flow_layers(pane, field, anatomy)]
    return next(scale for scale in scales_of(layers, anatomy) if scale.id == "shear")


def throated(strength, throat_Pa):
    """A flow whose artery has a throat of `throat_Pa` where it is 4 mm and more from the sac."""
    field = report_case.field(strength)
    (sac,) = report_case.anatomy().aneurysms
    is_far = sac.sac.closest(field.wall.vertices_mm)[1] > 4.0
    stress_Pa = np.where(is_far[:, None], throat_Pa * np.eye(3)[0], field.wall_shear_stress_Pa)
    return replace(field, wall_shear_stress_Pa=stress_Pa)


def test_scales_of_the_flow_are_as_wide_as_what_is_about_the_sac_before():
    case, tiny = report_case.case(), 1e-3
    near = case.anatomy.aneurysms[0].sac.closest(case.fields["bare"].wall.vertices_mm)[1] < 1.0
    wanted = round_up(np.percentile(case.fields["bare"].shear_Pa[near], 98))
    assert shear_scale(case.fields, case.anatomy).high == pytest.approx(wanted)
    # Neither a throat elsewhere nor what a device does takes the scale from the sac.
    throats = {"bare": throated(1.0, 60.0), "silk": throated(0.01, 90.0)}
    assert shear_scale(throats, case.anatomy).high == pytest.approx(wanted)
    slow = {"bare": replace(throats["bare"], wall_shear_stress_Pa=tiny * throats["bare"].wall_shear_stress_Pa)}
    assert shear_scale(slow, case.anatomy).high == pytest.approx(tiny * wanted)
    # Without a sac it is all about the whole wall.
    assert shear_scale(throats, replace(case.anatomy, aneurysms=())).high == round_up(90.0)


def test_pictures_of_the_flow_say_what_is_done_with_what_is_above_their_scale():
    words = {picture.id: picture.caption for picture in plates(report_case.scene())}
    assert all("Values above the scale have its last color." in words[name] for name in ("streamlines", "shear"))


@pytest.mark.parametrize(("value", "expected"), [(0.97, 1), (1.0, 1), (1.2, 1.5), (0.041, 0.05), (7.1, 8), (83, 100)])
def test_scales_end_on_round_numbers(value, expected):
    assert round_up(value) == pytest.approx(expected)


def test_colour_maps_grow_evenly_lighter():
    for scale in report_case.scene().scales:
        light = (scale.colours**2.2) @ [0.2126, 0.7152, 0.0722]
        lightness = 116 * np.cbrt(light) - 16
        assert (np.diff(lightness) > -0.3).all(), scale.id  # no rainbow: never darker again
        assert np.ptp(lightness) > 50


def test_thin_surface_keeps_the_shape_and_knows_where_its_vertices_come_from():
    ball = report_case.sphere(np.array([5.0, 0, 0]), 3.0, n=80)
    thin, origin = thin_surface(ball, 3000)
    assert len(thin.faces) <= 3000 < len(ball.faces)
    assert np.linalg.norm(thin.vertices_mm - [5, 0, 0], axis=1) == pytest.approx(3.0, abs=0.02)
    spacing = 3.0 * np.pi / 80
    assert np.linalg.norm(ball.vertices_mm[origin] - thin.vertices_mm, axis=1).max() < spacing
    assert thin_surface(ball, len(ball.faces))[0] is ball


def test_thin_lines_keep_both_ends_of_every_line():
    points = np.arange(33)[:, None] * np.ones(3)
    thin, starts, values = thin_lines(points, np.array([0, 20, 22, 33]), np.arange(33.0), 8)
    assert values.tolist() == [0, 5, 10, 15, 19, 20, 21, 22, 27, 32]
    assert starts.tolist() == [0, 5, 7, 10]
    assert thin[:, 0].tolist() == values.tolist()


def test_frames_close_in_on_the_wall_and_end_deployed():
    deployment = report_case.deployment("silk", 24)
    frames, gaps = thin_frames(deployment, report_case.tube(report_case.RADIUS_MM), n_frames=5)
    assert len(frames) == 5
    assert np.array_equal(frames[-1], deployment.stent.nodes_mm.reshape(-1, 3))
    assert np.array_equal(gaps[-1], deployment.wall_gap_mm.ravel())
    far = deployment.wall_gap_mm.ravel() < 0.031  # where the deployed gap is 0.03: 0.02 of 0.05 is the device
    assert gaps[0][far] == pytest.approx(2.0 - 0.9 - 0.02, abs=0.02)
    assert (np.diff(gaps, axis=0)[:, far] < 0).all()


def unpacked(scene):
    manifest, text = pack(scene, {})
    data = zlib.decompress(base64.b64decode(text))

    def integers(block):
        return np.frombuffer(data, f"<u{int(block['type'][1:]) // 8}", block["length"], block["offset"])

    def numbers(block):
        packed = integers(block).reshape(-1, len(block["low"]))
        return np.array(block["low"]) + np.array(block["step"]) * packed

    return manifest, integers, numbers


def test_packed_meshes_and_lines_unpack_within_half_a_step():
    scene = report_case.scene()
    manifest, integers, numbers = unpacked(scene)
    assert [layer["id"] for layer in manifest["layers"]] == [layer.id for layer in scene.layers]
    for packed, layer in zip(manifest["layers"], scene.layers, strict=True):
        if isinstance(layer, LineLayer):
            block, truth = packed["points"], layer.points_mm
            assert np.array_equal(integers(packed["starts"]), layer.starts)
            assert numbers(packed["radii"])[:, 0] == pytest.approx(layer.radius_mm, rel=1e-4)
        else:
            block = packed.get("frames") or packed["points"]
            truth = layer.surface.vertices_mm if layer.frames_mm is None else layer.frames_mm.reshape(-1, 3)
            assert np.array_equal(integers(packed["faces"]).reshape(-1, 3), layer.surface.faces)
        error = np.abs(numbers(block) - truth).max(axis=0)
        assert (error <= 0.5 * np.array(block["step"]) + 1e-12).all()
        assert max(block["step"]) < 0.001  # a micrometre
        if len(layer.values) and "values" in packed:
            assert np.abs(numbers(packed["values"])[:, 0] - layer.values).max() <= 0.51 * packed["values"]["step"][0]


def test_blocks_lie_on_multiples_of_four_and_do_not_overlap():
    manifest, integers, _ = unpacked(report_case.scene())
    blocks = [v for layer in manifest["layers"] for v in layer.values() if isinstance(v, dict)]
    blocks += [scale["colours"] for scale in manifest["scales"]]
    spans = sorted((block["offset"], block["offset"] + integers(block).nbytes) for block in blocks)
    assert all(start % 4 == 0 for start, _ in spans)
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(spans))


def test_a_case_without_flow_and_a_healthy_artery_have_scenes():
    case = report_case.case()
    anatomy = case.anatomy
    healthy = replace(anatomy, aneurysms=())
    scene = scene_of(healthy, {}, {})
    assert {layer.id for layer in scene.layers} == {"lumen", "landing", "centerlines", "axis"}
    assert scene.scales == ()
    assert scene.view("profile").axes[2] @ [0, 1, 0] == pytest.approx(np.sign(scene.view("profile").axes[2][1]))


def test_sac_and_artery_differ_without_color_vision():
    """Deuteranopia (Machado, Oliveira and Fernandes 2009, severity 1): the two still differ in lightness."""
    seen = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
    colors = {
        layer.id: np.array(layer.colour) for layer in report_case.scene().layers if layer.id in ("sac", "landing")
    }
    sac, artery = (np.clip(seen @ colors[name] ** 2.2, 0, 1) for name in ("sac", "landing"))
    luminance = np.array([0.2126, 0.7152, 0.0722])
    assert (luminance @ artery + 0.05) / (luminance @ sac + 0.05) > 3  # as graphics need (WCAG 1.4.11)
