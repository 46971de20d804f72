"""Streamlines: even seeds, and lines that follow a flow whose lines are known."""

from itertools import pairwise

import numpy as np
import pytest

import report_case
from vstent.report.streams import inlet_seeds_mm, neck_seeds_mm, streamlines


def test_inlet_seeds_fill_the_section_evenly():
    inlet = report_case.anatomy().vessel.inlet
    offset = inlet_seeds_mm(inlet) - inlet.center_mm
    assert offset @ inlet.normal == pytest.approx(-0.1 * inlet.diameter_mm)
    radius = np.linalg.norm(offset - np.outer(offset @ inlet.normal, inlet.normal), axis=1)
    assert radius.max() < 0.46 * inlet.diameter_mm
    inner = (radius < 0.45 * inlet.diameter_mm / np.sqrt(2)).mean()
    assert inner == pytest.approx(0.5, abs=0.02)  # half the area, half the seeds


def test_neck_seeds_take_equal_shares_of_the_neck():
    aneurysm = report_case.anatomy().aneurysms[0]
    seeds = neck_seeds_mm(aneurysm)
    assert aneurysm.neck.closest(seeds)[1].max() < 1e-9
    for axis in (0, 1):
        assert (seeds[:, axis] > 0).mean() == pytest.approx(0.5, abs=0.1)
    assert len(np.unique(seeds, axis=0)) == len(seeds)


def test_lines_of_a_bend_are_circles_at_its_speed():
    anatomy = report_case.anatomy()
    points, starts, speed = streamlines(report_case.field(1.0), anatomy)
    first = [slice(a, b) for a, b in pairwise(starts)][:60]
    center = np.hypot(points[:, 0], points[:, 2])
    inner = [line for line in first if np.hypot(center[line][0] - 9, points[line][0, 1]) < 1.2]
    assert len(inner) > 15
    for line in inner:
        assert np.ptp(points[line][:, 1]) < 0.02  # no drift along the bend's own axis
        assert np.ptp(center[line]) < 0.05
        assert points[line][-1, 0] > 6  # all the way round
        off = np.hypot(center[line].mean() - 9, points[line][:, 1].mean())
        assert speed[line].mean() == pytest.approx(0.5 * (1 - (off / 2) ** 2), rel=0.08)


def test_lines_through_the_neck_go_both_ways():
    _, starts, _ = streamlines(report_case.field(1.0), report_case.anatomy())
    healthy = report_case.anatomy()
    healthy = type(healthy)(
        healthy.vessel, healthy.axis, healthy.section_radius_mm, healthy.landing_surface, healthy.is_restored, ()
    )
    assert len(starts) - 1 > 2 * 50 + len(streamlines(report_case.field(1.0), healthy)[1]) - 1
