"""Devices inside others: no wire through another, and the metal of all of them over the neck."""

import numpy as np
import pytest
from brute import least_gap_mm
from tubes import arc, line, tube, with_neck

from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.coverage import density, together
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure
from vstent.deployment.wall import RAMP_MM
from vstent.devices.catalogue import find_design
from vstent.devices.stent import Landing
from vstent.devices.treatment import read_treatment
from vstent.study.stages import deploy_implant


def treated(text, anatomy):
    """The deployed devices of a treatment."""
    found = {}
    for implant in read_treatment(text).implants:
        found[implant.id] = deploy_implant(implant, anatomy, [found[name].stent for name in implant.inside])
    return list(found.values())


def straight():
    return with_neck(tube(line(50), 1.9), 22, 28)


def bend():
    return tube(arc(8, 2.4, 20), 1.9)


@pytest.mark.parametrize(
    ("text", "artery"),
    [
        ("silk + silk@-4", bend),
        ("enterprise + silk@-4", bend),
        ("silk + enterprise@-4", bend),
        ("neuroform_atlas + silk@-2", straight),
        ("neuroform_atlas + silk@-2", bend),
    ],
)
def test_no_wire_of_a_second_device_passes_through_one_of_the_first(text, artery):
    anatomy = artery()
    first, second = treated(text, anatomy)
    assert least_gap_mm(first.stent, second.stent) >= 0
    assert measure(anatomy, second)["max_outside_mm"] <= 0.002


@pytest.mark.validation
@pytest.mark.parametrize("text", ["silk + silk@-4", "silk + silk@-3 + silk@1"])
@pytest.mark.parametrize("case", ["aneurisk_C0038.vtp", "bifurcation_with_sac.stl"])
def test_no_wire_passes_through_another_in_real_arteries(shared_data, case, text):
    anatomy = restore(trim(trace(read_vessel(shared_data / case))))
    stents = [one.stent for one in treated(text, anatomy)]
    gaps_mm = [least_gap_mm(a, b) for k, b in enumerate(stents) for a in stents[:k]]
    assert min(gaps_mm) >= 0


def test_metal_of_two_braids_on_the_neck_counts_once_where_they_cross():
    anatomy = straight()
    stents = [one.stent for one in treated("silk + silk@-4", anatomy)]
    apart = [density(anatomy, stent)["neck_metal_coverage_fraction"] for stent in stents]
    both = together(anatomy, stents)
    # wires of the two devices are not in register, so that the open parts multiply
    assert both["neck_union_coverage_fraction"] == pytest.approx(1 - (1 - apart[0]) * (1 - apart[1]), abs=0.01)
    assert together(anatomy, stents[:1])["neck_union_coverage_fraction"] == pytest.approx(apart[0], abs=0.003)
    twice, once = (together(anatomy, stents[:1] * n)["neck_union_coverage_fraction"] for n in (2, 1))
    assert twice == once


def test_lengths_with_one_and_with_two_devices_add_up():
    anatomy = straight()
    stents = [one.stent for one in treated("silk + silk@-4 + enterprise@2", anatomy)]
    both = together(anatomy, stents)
    ends_mm = np.array([stent.mesh_abscissa_mm for stent in stents])
    assert both["covered_length_mm"] == pytest.approx(ends_mm[:, 1].max() - ends_mm[:, 0].min())
    places_mm = np.arange(0, 50, 0.001)
    layers = ((places_mm > ends_mm[:, :1]) & (places_mm < ends_mm[:, 1:])).sum(axis=0)
    assert both["overlap_length_mm"] == pytest.approx(0.001 * (layers > 1).sum(), abs=0.01)


def test_a_second_device_follows_the_first_when_that_is_moved():
    anatomy, silk = straight(), find_design("silk")
    seconds = []
    for there_mm in (23.0, 27.0):
        first = deploy(silk, anatomy, landing=Landing(there_mm)).stent
        seconds.append(deploy(silk, anatomy, landing=Landing(19.0), inside=(first,)).stent)
        radius_mm = np.linalg.norm(seconds[-1].nodes_mm[..., :2], axis=2)
        inside_mm = seconds[-1].row_abscissa_mm[radius_mm.max(axis=1) < 1.83].min()
        assert inside_mm == pytest.approx(first.proximal_abscissa_mm, abs=RAMP_MM)
    assert seconds[1].deployed_length_mm < seconds[0].deployed_length_mm - 0.05
