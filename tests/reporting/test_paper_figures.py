"""The equals of the paper's figures: free device, trimming, triangles, node rule."""

from dataclasses import replace

import numpy as np
import pytest
import report_case

from vstent.devices.catalogue import find_design
from vstent.devices.formulas import free_diameters_mm
from vstent.reporting import node_rule
from vstent.reporting.method import free_device, mesh_layers, method_plates, wire_layer
from vstent.reporting.scene import scene_of


def test_a_device_outside_an_artery_has_its_free_diameter_and_the_wires_of_the_catalogue():
    design = find_design("silk")
    stent = free_device(design, design.sizes[0])
    # A ring of n nodes is a polygon in its circle; its perimeter gives the diameter.
    np.testing.assert_allclose(stent.row_diameter_mm, free_diameters_mm(design, stent.size), rtol=0.005)
    layer = wire_layer(stent)
    of_wire = layer.values[layer.starts[:-1]]
    assert np.unique(of_wire, return_counts=True)[0].tolist() == [30.0, 50.0]
    assert [int((of_wire == diameter).sum()) for diameter in (50.0, 30.0)] == [8, 40]
    off_axis = np.linalg.norm(layer.points_mm[:, 1:], axis=1)
    assert off_axis.max() < 0.5 * stent.size.free_diameter_mm + 0.1


def test_all_edges_of_a_contour_are_drawn_once():
    rows, columns = 7, 12
    nodes = report_case.ring_points(
        *np.meshgrid(np.linspace(1, 2, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"), 1.0
    )
    surface, edges = mesh_layers(nodes)
    faces = len(surface.surface.faces)
    # Euler's formula of a tube: vertices - edges + faces = 0.
    assert len(edges.radius_mm) == rows * columns + faces
    assert faces == 2 * (rows - 1) * columns


@pytest.mark.parametrize("distance", [0.6, 0.92, 1.22])
def test_a_node_is_put_inside_the_wall_at_the_distance_of_the_rule(distance):
    node = distance * node_rule.RADIUS * np.array([0.6, 0.8])
    found = node_rule.placed(node)
    assert node_rule.RADIUS - np.linalg.norm(found) == pytest.approx(node_rule.OFFSET, rel=1e-12)
    assert found / np.linalg.norm(found) == pytest.approx([0.6, 0.8])


def test_a_vessel_that_was_not_trimmed_has_no_picture_of_it():
    anatomy = report_case.anatomy()
    vessel, scene = anatomy.vessel, scene_of(anatomy, {}, {})

    def ids(whole):
        return [plate.id for plate in method_plates(anatomy, {}, scene, whole)]

    assert ids(vessel) == ids(None) == ["restoration", "spheres"]
    larger = replace(vessel, lumen=report_case.joined(vessel.lumen, report_case.sphere(np.array([30.0, 0, 0]), 3.0)))
    assert ids(larger) == ["untrimmed", "restoration", "spheres"]
