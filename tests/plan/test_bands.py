"""Bands from the ranges of a device: the closed formulas at their ends in a tube, and full deployments elsewhere."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tubes import arc, line, tube, with_neck

from vstent.cli.console import device_sentences
from vstent.deployment.deploy import deploy, propose_size
from vstent.deployment.measure import measure
from vstent.devices import formulas
from vstent.devices.catalogue import catalogue, find_design, find_size
from vstent.devices.ranges import MARGIN, altered, uncertain, values_at
from vstent.devices.stent import Landing
from vstent.errors import VstentError
from vstent.plan.bands import SAMPLES, bands, gap_bands, interval, length_band
from vstent.plan.rank import rank
from vstent.plan.shares import INTERVAL, centered_points
from vstent.reporting.uncertainty import band_rows, ends, how_sure, number_name

SILK = find_design("silk")
ENTERPRISE = find_design("enterprise")
SIZE = find_size(SILK, diameter_mm=4, length_mm=15)
RADIUS_MM = 1.9
WIDE_MM = 2.3
"""Radius of an artery wider than the device."""
MIDDLE_MM = 16.0


@cache
def straight(radius_mm=RADIUS_MM):
    return with_neck(tube(line(32.0), radius_mm), 14.0, 18.0)


@cache
def lying(radius_mm=RADIUS_MM):
    deployment = deploy(SILK, straight(radius_mm), size=SIZE, landing=Landing(MIDDLE_MM))
    return deployment, measure(straight(radius_mm), deployment)


def altered_silks():
    ranges = uncertain(SILK)
    return [altered(SILK, SIZE, values_at(ranges, at)) for at in centered_points(len(ranges), SAMPLES)]


def formula(design, size):
    """Length, coverage and pore density in the straight tube."""
    diameter_mm = 2 * (RADIUS_MM - 1e-3 * design.wall_offset_um)
    return (
        formulas.deployed_length_mm(design, size, diameter_mm),
        formulas.coverage_fraction(design, size, diameter_mm),
        formulas.pore_density_per_mm2(design, size, diameter_mm),
    )


def test_in_a_straight_tube_the_band_is_that_of_the_closed_formulas():
    found = bands(straight(), *lying()).results
    wanted = np.quantile([formula(*device) for device in altered_silks()], INTERVAL, axis=0)
    nominal = formula(SILK, SIZE)
    for k, name in enumerate(("deployed_length_mm", "neck_metal_coverage_fraction", "neck_pore_density_per_mm2")):
        scale = lying()[1][name] / nominal[k]  # as measured on the drawn wires
        assert (found[name].low, found[name].high) == pytest.approx(scale * wanted[:, k], rel=0.02), name


def test_the_ends_move_as_the_length_and_shares_name_what_moves_it():
    found = bands(straight(), *lying()).results
    ends = ("proximal_end_abscissa_mm", "distal_end_abscissa_mm")
    length, first, last = (found[name] for name in ("deployed_length_mm", *ends))
    assert first.high - first.low + last.high - last.low == pytest.approx(length.high - length.low, rel=0.02)
    assert first.low < MIDDLE_MM < last.high
    assert set(length.shares) <= {one.name for one in uncertain(SILK)}
    assert list(length.shares.values()) == sorted(length.shares.values(), reverse=True)
    assert 0.8 < sum(length.shares.values()) <= 1.0


def test_one_uncertain_number_makes_the_whole_band():
    only = tuple(one for one in SILK.ranges if one.name == "braid_angle_rad")
    deployment, measures = lying()
    stent = replace(deployment.stent, design=replace(SILK, ranges=only))
    found = bands(straight(), replace(deployment, stent=stent), measures).results["deployed_length_mm"]
    assert found.shares == {"braid_angle_rad": pytest.approx(1.0, abs=0.02)}
    lengths = [
        formula(*altered(SILK, SIZE, {"braid_angle_rad": only[0].low + share * (only[0].high - only[0].low)}))[0]
        for share in INTERVAL
    ]
    assert (found.low, found.high) == pytest.approx(sorted(lengths), rel=0.01)


def at_its_free_diameter():
    """Range of the free diameter, a deployment of which only that is uncertain, and its measures."""
    (margin,) = (one for one in SILK.ranges if one.name == MARGIN)
    deployment, measures = lying(WIDE_MM)
    stent = replace(deployment.stent, design=replace(SILK, ranges=(margin,)))
    return margin, replace(deployment, stent=stent), measures


def test_a_braid_in_a_wide_artery_stands_off_by_half_of_what_its_free_diameter_lacks():
    margin, of_margin, measures = at_its_free_diameter()
    gap = gap_bands(straight(WIDE_MM), of_margin, measures)["max_wall_gap_mm"]
    at = [margin.low + share * (margin.high - margin.low) for share in reversed(INTERVAL)]
    wanted = [measures["max_wall_gap_mm"] - 0.5 * (value - margin.value) for value in at]
    assert (gap.low, gap.high) == pytest.approx(wanted, abs=0.01)


def test_a_braid_at_its_free_diameter_is_as_long_as_deployed_with_another_one():
    margin, of_margin, measures = at_its_free_diameter()
    length = bands(straight(WIDE_MM), of_margin, measures).results["deployed_length_mm"]
    others = [altered(SILK, SIZE, {MARGIN: margin.low + share * (margin.high - margin.low)}) for share in INTERVAL]
    lengths_mm = [
        deploy(design, straight(WIDE_MM), size=size, landing=Landing(MIDDLE_MM)).stent.deployed_length_mm
        for design, size in others
    ]
    assert max(lengths_mm) > 1.05 * min(lengths_mm)
    assert (length.low, length.high) == pytest.approx(sorted(lengths_mm), rel=0.01)


def test_ends_of_an_outer_layer_do_not_move_the_mesh():
    design = find_design("fred")
    size = find_size(design, diameter_mm=4, length_mm=14)
    (beyond,) = (one for one in design.ranges if one.name == "outer_layer_beyond_mm")
    only = replace(design, ranges=(beyond,))
    deployment = deploy(only, straight(), size=size, landing=Landing(MIDDLE_MM))
    measures = measure(straight(), deployment)
    found = bands(straight(), deployment, measures).results
    for name in ("neck_to_proximal_end_mm", "neck_to_distal_end_mm", "mesh_length_mm"):
        assert found[name].high - found[name].low < 1e-6, name
    length = found["deployed_length_mm"]
    spacing_mm = np.diff(deployment.stent.row_abscissa_mm).mean()
    # The outer layer ends after so many rows of the label diameter; in the narrower artery rows are further apart.
    longer = spacing_mm * formulas.grid(only, size).row_split / formulas.row_spacing_mm(only, size, size.diameter_mm)
    wanted_mm = 2 * 0.95 * longer * (beyond.high - beyond.low)
    assert length.high - length.low == pytest.approx(wanted_mm, abs=2 * spacing_mm)  # whole rows


def test_a_band_contains_the_result_it_belongs_to():
    samples = np.linspace(0.0, 1.0, 41)  # quantiles 0.025 and 0.975 are the second and the last but one
    assert interval(samples, 0.5) == pytest.approx((0.025, 0.975))
    assert interval(samples, -0.2) == pytest.approx((-0.2, 0.975))
    assert interval(samples, 1.3) == pytest.approx((0.025, 1.3))
    for name, band in bands(straight(), *lying()).results.items():
        assert band.low <= lying()[1][name] <= band.high, name


def test_a_device_whose_numbers_are_exact_has_no_bands():
    deployment, measures = lying()
    bare = replace(deployment, stent=replace(deployment.stent, design=replace(SILK, ranges=())))
    assert bands(straight(), bare, measures).metrics() == {"results": {}}
    assert length_band(straight(), bare, measures) is None
    assert gap_bands(straight(), bare, measures) == {}
    told = {"deployment": measures, "bands": {"results": {}, "device": "Numbers of X: 3 cited."}}
    assert how_sure(told) == "Numbers of X: 3 cited."
    assert band_rows(told) == []
    assert how_sure({"deployment": measures}) == ""  # metrics of a version without bands


def test_bands_are_told_in_words_with_their_largest_cause():
    deployment, measures = lying()
    found = bands(straight(), deployment, measures, is_proposed=True)
    told = {"deployment": measures, "bands": json.loads(json.dumps(found.metrics())) | {"device": "Numbers."}}
    (length,) = (row for row in band_rows(told) if row.name == "Deployed length")
    band = found.results["deployed_length_mm"]
    assert (length.low, length.high) == (f"{band.low:.1f}\u202fmm", f"{band.high:.1f}\u202fmm")
    assert ends(told, "deployed_length_mm") == f"({band.low:.1f} to {band.high:.1f}\u202fmm)"
    assert number_name(next(iter(band.shares))) in length.cause
    assert f"(mostly the {number_name(next(iter(band.shares)))})" in how_sure(told)
    assert ends(told, "apposed_fraction") == ""  # it lies on the wall whatever its numbers are
    assert number_name("wire_2_diameter_um") == "wire diameter of the second kind of wire"
    assert number_name("wire_5_count") == "number of wires of the 5th kind of wire"


def test_the_numbers_of_a_device_are_told_once_where_two_implants_are_of_it():
    deployment, measures = lying()
    found = bands(straight(), deployment, measures, is_proposed=False).metrics()
    one = measures | {"bands": found | {"device": "Numbers of Silk: 2 cited."}}
    alone = device_sentences({"treatments": {"bare": {}, "silk": {"implants": {"silk": one}}}})
    assert alone == [how_sure(one, "silk").replace("\u202f", " ")]
    (both,) = device_sentences({"treatments": {"bare": {}, "two": {"implants": {"silk": one, "silk_2": one}}}})
    assert both.count("Numbers of Silk") == 1
    assert both.count("deployed length") == 1  # the table has the ranges of both
    assert "these numbers (silk of two): " in both


def test_the_proposed_size_has_a_band_in_an_artery_between_two_sizes():
    size = propose_size(SILK, straight())
    deployment = deploy(SILK, straight(), size=size)
    found = bands(straight(), deployment, measure(straight(), deployment), is_proposed=True)
    assert found.sizes
    assert all(one in SILK.sizes for one in found.sizes)


def test_a_ranking_states_the_band_of_every_suitable_length():
    ranking = rank(straight(), [replace(SILK, sizes=(SIZE,))])
    (only,) = ranking.candidates
    assert only.is_suitable, only.reason
    assert only.measures["deployed_length_low_mm"] < only.measures["deployed_length_mm"]
    assert only.measures["deployed_length_mm"] < only.measures["deployed_length_high_mm"]
    assert only.measures["deployed_length_band_cause"] in {one.name for one in uncertain(SILK)}


@cache
def bent():
    return tube(arc(9.0, 1.0, straight_mm=14.0), 1.8)


def sampled(design, size, landing, count):
    """Results of full deployments of altered devices in the bend."""
    found = []
    for point in centered_points(len(uncertain(design)), count):
        try:
            other, other_size = altered(design, size, values_at(uncertain(design), point))
            found.append(measure(bent(), deploy(other, bent(), size=other_size, landing=landing)))
        except VstentError:
            continue
    return found


def compared(key, count):
    """Width of the band over that of full deployments, by result."""
    design = catalogue()[key]
    size = min(design.sizes, key=lambda one: (abs(one.diameter_mm - 3.75), one.length_mm))
    landing = Landing(0.5 * bent().parent.axis.length_mm)
    deployment = deploy(design, bent(), size=size, landing=landing)
    measures = measure(bent(), deployment)
    found = bands(bent(), deployment, measures).results | gap_bands(bent(), deployment, measures)
    others = sampled(design, size, landing, count)
    widths = {name: np.ptp(np.quantile([float(one[name]) for one in others], INTERVAL)) for name in found}
    return {name: (found[name].high - found[name].low) / width for name, width in widths.items() if width > 1e-3}


def test_in_a_bend_the_band_of_the_length_is_that_of_full_deployments():
    ratios = compared("lvis", 16)
    # 16 deployments leave out a part of the ends that 128 samples have
    assert ratios["deployed_length_mm"] == pytest.approx(1.0, abs=0.25)


def test_bands_of_gaps_are_those_of_deployments_in_any_process():
    design = replace(ENTERPRISE, ranges=tuple(one for one in ENTERPRISE.ranges if one.name != "n_columns"))
    size, landing = find_size(design, length_mm=14), Landing(0.5 * bent().parent.axis.length_mm)
    deployment = deploy(design, bent(), size=size, landing=landing)
    measures = measure(bent(), deployment)
    found = gap_bands(bent(), deployment, measures, jobs=2)
    others = sampled(design, size, landing, 32)
    assert len(others) == 32
    for name, band in found.items():
        ends = np.quantile([one[name] for one in others], INTERVAL)
        assert (band.low, band.high) == (min(ends[0], measures[name]), max(ends[1], measures[name]))
        assert band.high - band.low > 0.1
    assert set(found) == {"apposed_fraction", "max_wall_gap_mm"}
    assert max(found["max_wall_gap_mm"].shares.values()) > 0.3


@pytest.mark.validation
@pytest.mark.parametrize("key", catalogue())
def test_in_a_bend_bands_are_those_of_128_full_deployments(key):
    ratios = compared(key, 128)
    assert ratios["deployed_length_mm"] == pytest.approx(1.0, abs=0.2)
    assert max(ratios.values()) < 2.0


@pytest.mark.parametrize(("dimensions", "samples"), [(1, 1), (5, 16), (7, 100), (24, 128), (25, 8), (3, 200)])
def test_points_are_those_of_scipys_sobol_sequence_whether_stored_or_not(dimensions, samples):
    from scipy.stats.qmc import Sobol

    unit = Sobol(dimensions, scramble=False).random_base2(int(np.ceil(np.log2(samples))))
    np.testing.assert_array_equal(centered_points(dimensions, samples), 2 * (unit + 0.5 / len(unit)) - 1)
