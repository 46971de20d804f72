"""Uncertainty: intervals and shares against closed formulas, and against brute-force integrals."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tubes import arc, line, tube, with_neck

from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.cli import main
from vstent.cli.finished import RECORD
from vstent.deployment.deploy import deploy
from vstent.deployment.straightening import straighten
from vstent.devices import catalogue, formulas
from vstent.devices.ranges import altered, uncertain, values_at
from vstent.devices.stent import Landing
from vstent.errors import InputError
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Vessel
from vstent.io.writers import write_stl
from vstent.phantoms import demo_phantom, phantom_surface
from vstent.plan import uncertainty
from vstent.plan.ranges import Ranges
from vstent.plan.shares import first_order_shares
from vstent.plan.uncertainty import CAUSES, STIFFNESS, Uncertainty, vary
from vstent.plan.widening import widened
from vstent.study.folder import CACHE
from vstent.study.store import Unfinished

LOOSE = replace(catalogue.find_design("silk"), wires=((4, 50.0), (20, 30.0)))
"""A Silk of half as many wires, which is deployed in a third of the time."""
SILK = replace(LOOSE, ranges=())  # the numbers of the device are held where not said otherwise
SIZE = catalogue.find_size(SILK, diameter_mm=4, length_mm=15)
RADIUS_MM, LENGTH_MM, DD_MM = 1.9, 32.0, 0.05


@cache
def artery():
    return with_neck(tube(line(LENGTH_MM), RADIUS_MM), 14.0, 18.0)


@cache
def deployed():
    return deploy(SILK, artery(), size=SIZE, landing=Landing(16.0))


def length_mm(threshold_mm, wider_mm=0.0):
    """The closed formula: what a Silk measures in a straight tube that is `threshold_mm` wider."""
    diameter_mm = 2 * (RADIUS_MM - DD_MM) + threshold_mm
    # as many rows of pieces longer in proportion: all lengths of the lattice scale with the free diameter
    factor = 1 + wider_mm / SIZE.free_diameter_mm
    return factor * formulas.deployed_length_mm(SILK, SIZE, diameter_mm / factor)


def test_of_a_threshold_alone_the_interval_is_the_closed_formula_at_its_ends():
    found = vary(artery(), deployed(), Ranges(16, threshold_mm=0.2, landing_mm=0.0, device_mm=0.0))
    mean, low, high = found.interval("deployed_length_mm")
    widths = 0.2 * found.points[:, 0]
    wanted = np.array([length_mm(width) for width in widths])
    assert found.values[:, 0] == pytest.approx(wanted, rel=1e-3)
    assert mean == pytest.approx(wanted.mean(), rel=1e-3)
    # 95 % of a uniform range of 0.2 mm to either side, less what 16 samples leave out
    assert low == pytest.approx(length_mm(0.19), rel=0.02)
    assert high == pytest.approx(length_mm(-0.19), rel=0.02)
    assert found.shares("deployed_length_mm")["threshold"] == pytest.approx(1.0, abs=1e-3)


def test_shares_of_two_causes_are_their_first_order_indices():
    found = vary(artery(), deployed(), Ranges(32, threshold_mm=0.1, landing_mm=1.0, device_mm=0.1))
    at, weight = np.polynomial.legendre.leggauss(12)
    lengths = np.array([[length_mm(0.1 * t, 0.1 * w) for w in at] for t in at])
    weights = np.outer(weight, weight) / 4
    mean = (weights * lengths).sum()
    variance = (weights * (lengths - mean) ** 2).sum()
    of_threshold, of_device = lengths @ weight / 2, weight @ lengths / 2
    wanted = {
        "threshold": (weight / 2 @ (of_threshold - mean) ** 2) / variance,
        "device": (weight / 2 @ (of_device - mean) ** 2) / variance,
        "landing": 0.0,
    }
    shares = found.shares("deployed_length_mm")
    assert {name: shares[name] for name in wanted} == pytest.approx(wanted, abs=0.02)
    assert sum(shares.values()) == pytest.approx(1.0)
    # how far the ends reach beyond the neck is moved by the landing, one to one
    both = found.values[:, [found.names.index(f"neck_to_{end}_end_mm") for end in ("proximal", "distal")]]
    shift = (both[:, 1] - both[:, 0]) / 2
    assert np.ptp(shift - found.points[:, 1]) < 0.1
    assert found.shares("neck_to_distal_end_mm")["landing"] > 0.5


def test_few_results_show_no_share_that_may_be_chance():
    """Of causes without effect, one in twenty passes a test of 95 %; without the test each gets about a tenth."""
    rng = np.random.default_rng(7)
    found = [first_order_shares(rng.uniform(-1, 1, (16, 4)), rng.normal(size=16)) for _ in range(400)]
    assert 0.02 < np.mean(np.array(found) > 0) < 0.08
    strong = [rng.uniform(-1, 1, (16, 4)) for _ in range(50)]
    shares = [first_order_shares(points, points[:, 0] + 0.1 * rng.normal(size=16)) for points in strong]
    assert np.mean([share[0] > 0.8 for share in shares]) > 0.9


def test_a_fit_finds_the_shares_of_any_sum_of_quadratics_and_leaves_interplay_to_the_rest():
    points = np.random.default_rng(1).uniform(-1, 1, (64, 3))
    x, y, _ = points.T
    shares = first_order_shares(points, 3 * x + 2 * y**2)
    assert shares == pytest.approx(np.array([3, 4 * 4 / 45, 0]) / (3 + 16 / 45), abs=1e-6)
    # twice as many causes and few points: the first degree alone
    assert first_order_shares(points[:8], 3 * x[:8] + y[:8]) == pytest.approx([0.9, 0.1, 0.0], abs=1e-6)
    many = np.random.default_rng(1).uniform(-1, 1, (1024, 3))
    interplay = first_order_shares(many, many[:, 0] + 3 * many[:, 1] * many[:, 2])  # of 1/3 + 9/9, a quarter is x's
    assert interplay == pytest.approx([0.25, 0.0, 0.0], abs=0.01)
    assert first_order_shares(points, np.full(64, 7.0)).tolist() == [0, 0, 0]
    assert first_order_shares(points[:4], x[:4]) is None


def test_points_are_spread_evenly_in_every_cause_and_are_always_the_same():
    found = vary(artery(), deployed(), Ranges(7, threshold_mm=0.0, landing_mm=0.5, device_mm=0.0))
    assert len(found.points) == 8
    for column in found.points.T:
        assert np.sort(column) == pytest.approx((2 * np.arange(8) + 1) / 8 - 1)
    again = vary(artery(), deployed(), Ranges(8, threshold_mm=0.0, landing_mm=0.5, device_mm=0.0))
    assert (again.values == found.values).all()


def test_a_device_that_leaves_the_artery_is_counted_and_left_out():
    short = with_neck(tube(line(20.0), RADIUS_MM), 8.0, 12.0)
    lies = deploy(SILK, short, size=SIZE, landing=Landing(10.0))
    found = vary(short, lies, Ranges(8, threshold_mm=0.0, landing_mm=4.0, device_mm=0.0))
    spare_mm = 10.0 - 0.5 * lies.stent.deployed_length_mm
    assert found.n_failed == int((np.abs(4.0 * found.points[:, 1]) > spare_mm + 0.05).sum())
    assert 0 < found.n_failed < 8
    assert found.metrics()["failed_count"] == found.n_failed


def test_metrics_are_finite_numbers_in_their_units():
    found = vary(artery(), deployed(), Ranges(8, threshold_mm=0.1)).metrics()
    assert found["ranges"] == {"threshold_mm": 0.1, "landing_mm": 1.0, "device_mm": 0.1, "inflow_fraction": 0.2}
    for name, interval in found["intervals"].items():
        assert interval["low"] <= interval["mean"] <= interval["high"]
        assert sum(found["shares"][name].values()) == pytest.approx(1.0) or interval["low"] == interval["high"]
    assert set(found["shares"]["deployed_length_mm"]) == {f"{name}_fraction" for name in (*CAUSES, "rest")}


def test_the_numbers_of_the_device_vary_within_their_ranges():
    design = LOOSE
    lies = deploy(design, artery(), size=SIZE, landing=Landing(16.0))
    still = {"threshold_mm": 0.0, "landing_mm": 0.0, "device_mm": 0.0, "inflow_fraction": 0.0}
    found = vary(artery(), lies, Ranges(32, **still))
    assert found.numbers == tuple(one.name for one in uncertain(design))
    wanted = []
    for point in found.points[:, len(CAUSES) :]:
        other, size = altered(design, SIZE, values_at(uncertain(design), point))
        wanted.append(formulas.deployed_length_mm(other, size, 2 * (RADIUS_MM - other.wall_offset_um * 1e-3)))
    assert found.values[:, 0] == pytest.approx(wanted, rel=2e-3)
    shares = found.shares("deployed_length_mm")
    assert max(shares, key=shares.get) in ("braid_angle_rad", "free_diameter_margin_mm", "label_length_mm")
    assert "braid_angle_rad" in found.metrics()["numbers"]
    assert vary(artery(), lies, Ranges(2, numbers_factor=0.0, **still)).interval("deployed_length_mm")[1:] == (
        pytest.approx(2 * (lies.stent.deployed_length_mm,), rel=1e-9)
    )
    (half,) = (one for one in Ranges(numbers_factor=0.5).numbers_of(design) if one.name == "braid_angle_rad")
    (whole,) = (one for one in uncertain(design) if one.name == "braid_angle_rad")
    middle = design.angle_rad
    assert (half.low, half.high) == pytest.approx(((middle + whole.low) / 2, (middle + whole.high) / 2))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"samples": 1}, "give 2 to 4096"),
        ({"flow_samples": -1}, "uncertainty flows: -1 is out of range: give at least 0"),
        ({"landing_mm": -1.0}, "vary landing"),
        ({"landing_mm": float("nan")}, "vary landing"),
        ({"threshold_mm": float("inf")}, "vary threshold"),
        ({"device_mm": -0.1}, "vary device"),
        ({"inflow_fraction": 1.0}, "give 0 to 0.99"),
        ({"numbers_factor": 1.5}, "give 0 to 1"),
    ],
)
def test_ranges_that_cannot_be_are_refused(given, said):
    with pytest.raises(InputError, match=said):
        Ranges(**given)


@pytest.mark.parametrize("device_mm", [0.43, 5.0])
def test_a_device_made_so_much_wider_that_it_is_another_is_refused(device_mm):
    with pytest.raises(InputError, match=r"a free diameter of 4\.20 mm is not made .* give a range below 0\.42 mm"):
        vary(artery(), deployed(), Ranges(2, device_mm=device_mm))


def test_a_threshold_that_would_close_the_artery_is_refused():
    with pytest.raises(InputError, match="close the artery"):
        vary(artery(), deployed(), Ranges(16, threshold_mm=2.0))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--vary-landing", "2"], "--vary-landing needs --uncertainty N"),
        (["--uncertainty-flows", "2"], "--uncertainty-flows needs --uncertainty N"),
    ],
)
def test_the_command_refuses_them_before_anything_is_read(words, said, tmp_path, capsys):
    assert main(["run", str(tmp_path / "none.stl"), "--out", str(tmp_path / "out"), *words]) == 2
    assert said in capsys.readouterr().err


def test_a_widened_artery_is_wider_by_as_much_everywhere_and_its_sac_stays_closed():
    vessel = trace(Vessel(phantom_surface(demo_phantom(), edge_mm=0.5)))
    anatomy = restore(vessel)
    other = widened(anatomy, 0.2)
    away_mm = anatomy.parent.landing_surface.closest(other.parent.landing_surface.vertices_mm)[1]
    assert away_mm == pytest.approx(0.1, abs=0.02)
    assert other.parent.section_radius_mm == pytest.approx(anatomy.parent.section_radius_mm + 0.1)
    sac, wider = anatomy.aneurysms[0], other.aneurysms[0]
    assert not wider.sac.boundary_loops
    # the sac grows by its wall's area times the shift, and loses what its neck moves in
    wall_mm2 = sac.sac.area_mm2 - sac.neck.area_mm2
    grown_mm3 = abs(wider.sac.volume_mm3) - abs(sac.sac.volume_mm3)
    assert grown_mm3 == pytest.approx(0.1 * (wall_mm2 - sac.neck.area_mm2), rel=0.1)
    on_tube = other.parent.landing_surface.closest(wider.neck.vertices_mm)[1]
    assert on_tube.max() < 0.03
    opening, wide = anatomy.vessel.inlet, other.vessel.inlet
    assert wide.diameter_mm == pytest.approx(opening.diameter_mm + 0.2)
    back = widened(other, -0.2)
    assert np.abs(back.vessel.lumen.vertices_mm - anatomy.vessel.lumen.vertices_mm).max() < 0.05


def test_inflow_and_flow_are_varied_where_the_flow_is_asked(monkeypatch):
    """A flow whose answer is known: what enters the sac is the inflow squared, and a device takes half."""

    def answer(case, start=None):
        return case

    def known(case, *shapes):
        inflow = case.inflow_mL_s
        return {"neck_inflow_mL_s": 0.1 * inflow**2 if case.media else inflow}

    monkeypatch.setattr(uncertainty, "simulate_case", answer)
    monkeypatch.setattr(uncertainty, "indices", known)
    monkeypatch.setattr(uncertainty, "sac_surfaces", lambda *_: ())
    monkeypatch.setattr("vstent.flow.problem.ostium", lambda *_: None)
    ranges = Ranges(8, flow_samples=8, threshold_mm=0.0, landing_mm=0.5, device_mm=0.0)
    found = vary(artery(), deployed(), ranges, flow=FlowSettings(inflow_mL_s=4.0))
    ratio = found.values[:, found.names.index("neck_inflow_mL_s_ratio")]
    assert ratio == pytest.approx(0.1 * 4.0 * (1 + 0.2 * found.points[:, 3]))
    shares = found.shares("neck_inflow_mL_s_ratio")
    assert shares["inflow"] == pytest.approx(1.0, abs=1e-6)


def test_a_sample_whose_flow_is_done_is_not_computed_again(monkeypatch, tmp_path):
    asked = []

    def ratios(_, found):
        inflow_mL_s = found["inlet_flow_mL_s"]
        asked.append(inflow_mL_s)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return {"neck_inflow_mL_s_ratio": inflow_mL_s**2}

    monkeypatch.setattr(uncertainty, "ratios", ratios)
    monkeypatch.setattr(uncertainty, "simulate_case", lambda case, start=None: case)
    monkeypatch.setattr(uncertainty, "indices", lambda case, *_: {"inlet_flow_mL_s": case.inflow_mL_s})
    monkeypatch.setattr(uncertainty, "sac_surfaces", lambda *_: ())
    monkeypatch.setattr("vstent.flow.problem.ostium", lambda *_: None)
    ranges = Ranges(4, flow_samples=4, threshold_mm=0.0, landing_mm=0.5, device_mm=0.0)
    begun, flow = Unfinished(tmp_path, "vary silk-key"), FlowSettings(inflow_mL_s=4.0)
    with pytest.raises(KeyboardInterrupt):
        vary(artery(), deployed(), ranges, flow=flow, checkpoint=begun)
    resumed = vary(artery(), deployed(), ranges, flow=flow, checkpoint=begun)
    assert len(asked) == 3 + 2
    assert asked[3] == asked[2]  # the one that was interrupted is the first to be done
    once = vary(artery(), deployed(), ranges, flow=flow)
    assert resumed.names == once.names
    assert (resumed.values == once.values).all()


def test_a_study_tells_its_uncertainty_in_metrics_report_and_table_and_goes_on_from_it(tmp_path, capsys):
    write_stl(tmp_path / "a.stl", phantom_surface(demo_phantom(), edge_mm=0.6))
    out = tmp_path / "out"
    command = ["run", str(tmp_path / "a.stl"), "--out", str(out), "--units", "mm", "--device", "enterprise"]
    command += ["--no-flow", "--uncertainty", "8", "--vary-threshold", "0.2", "--vary-landing", "2"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "causes" in said
    treatment = json.loads((out / "metrics.json").read_text())["treatments"]["enterprise"]
    assert treatment["uncertainty"]["ranges"]["landing_mm"] == 2.0
    interval = treatment["uncertainty"]["intervals"]["deployed_length_mm"]
    assert interval["low"] < treatment["implants"]["enterprise"]["deployed_length_mm"] < interval["high"]
    page = (out / "report.html").read_text()
    section = page[page.index('<section id="uncertainty">') : page.index('<section id="notes">')]
    assert "all diameters ±0.200\u202fmm" in section
    assert f"{interval['low']:.1f} to {interval['high']:.1f}\u202fmm" in section
    before = (out / "metrics.json").read_bytes()
    next((out / CACHE).glob(f"{RECORD}-*")).unlink()  # so that the command is not answered from its record
    assert main(command) == 0
    assert "vary enterprise" in capsys.readouterr().err
    assert (out / "metrics.json").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--uncertainty", "1"], "--uncertainty: 1 is out of range: give 2 to 4096"),
        (["--uncertainty-flows", "-1"], "--uncertainty-flows: -1 is out of range: give at least 0"),
        (["--vary-landing", "nan"], "--vary-landing: 'nan' is not a number"),
        (["--vary-device", "-1"], "--vary-device: -1 mm is out of range: give at least 0 mm"),
        (["--vary-inflow", "1"], "--vary-inflow: 1 is out of range: give 0 to 0.99"),
        (["--vary-weather", "1"], "unrecognized"),
    ],
)
def test_causes_are_checked(words, said, capsys):
    with pytest.raises(SystemExit):
        main(["run", "a.stl", "--out", "out", *words])
    assert said in capsys.readouterr().err


def test_the_band_of_the_neck_is_among_the_intervals():
    from vstent.reporting.uncertainty import intervals

    found = Uncertainty(np.ones(4), np.zeros((2, 4)), ("a_mm",), np.ones((2, 1)), neck_mm2=(10.0, 9.0, 12.0)).metrics()
    assert found["intervals"]["neck_plane_area_mm2"] == {"mean": 10.0, "low": 9.0, "high": 12.0}
    row = intervals({"uncertainty": found})[-1]
    assert (row.mean, row.low, row.high) == ("10.0\u202fmm²", "9.00\u202fmm²", "12.0\u202fmm²")
    assert row.shares == [("choice of the neck plane", 1.0)]


@pytest.fixture(scope="module")
def bent():
    """An artery with a bend of 90 degrees and 7 mm and a neck, and an Enterprise in it whose numbers have no ranges."""
    anatomy = with_neck(tube(arc(7.0, np.pi / 2, straight_mm=16.0), 1.6, around=32), 19.0, 23.0)
    design = replace(catalogue.find_design("enterprise"), ranges=())
    return anatomy, deploy(design, anatomy, size=design.sizes[0])


STILL = {"threshold_mm": 0.0, "landing_mm": 0.0, "device_mm": 0.0, "inflow_fraction": 0.0}


def test_the_stiffness_varies_in_an_artery_that_yields(bent):
    """Its samples are those of `straighten` between the ends of the range, and it is the only cause."""
    anatomy, lies = bent
    found = vary(anatomy, lies, Ranges(8, **STILL), straightening="immediate")
    assert found.causes == (*CAUSES, STIFFNESS)
    opened, radius = (found.values[:, found.names.index(one)] for one in ("straightened_rad", "bend_radius_after_mm"))
    order = np.argsort(found.points[:, -1])
    assert (np.diff(opened[order]) > 0).all()
    assert (np.diff(radius[order]) > 0).all()
    whole = straighten(anatomy, [lies]).metrics()
    assert whole["straightened_low_rad"] < opened.min() < whole["straightened_rad"] < opened.max()
    assert opened.max() < whole["straightened_high_rad"]
    ends = [straighten(anatomy, [lies], place=place).metrics()["straightened_rad"] for place in (-1.0, 1.0)]
    assert ends == pytest.approx([whole["straightened_low_rad"], whole["straightened_high_rad"]], rel=0.1)
    assert found.shares("straightened_rad")[STIFFNESS] > 0.95
    assert np.ptp(found.values[:, 0]) == 0.0  # the device of the plan lies in the rigid artery


def test_a_measured_angle_has_no_range(bent):
    anatomy, lies = bent
    found = vary(anatomy, lies, Ranges(2, **STILL), straightening="4deg")
    assert found.causes == CAUSES
    assert np.degrees(found.interval("straightened_rad")) == pytest.approx(3 * (4.0,), abs=0.6)
    failed = vary(anatomy, lies, Ranges(2, **STILL), straightening="170deg")  # no stiffness gives it
    assert failed.n_failed == 0
    assert "straightened_rad" not in failed.names


def test_flows_in_the_artery_that_yields_are_relative_to_the_rigid_one(bent, monkeypatch):
    """A flow whose neck inflow is the length of the axis, and 100 less for every device."""
    monkeypatch.setattr(uncertainty, "simulate_case", lambda case, start=None: case)
    monkeypatch.setattr(uncertainty, "flow_case", lambda artery, stents, flow: Known(artery, len(stents)))
    monkeypatch.setattr(uncertainty, "indices", lambda case, *_: {"neck_inflow_mL_s": case.speed})
    monkeypatch.setattr(uncertainty, "sac_surfaces", lambda *_: ())
    anatomy, lies = bent
    ranges = Ranges(2, flow_samples=2, **STILL)
    found = vary(anatomy, lies, ranges, flow=FlowSettings(inflow_mL_s=4.0), straightening="immediate")
    length_mm = anatomy.parent.axis.length_mm
    for row in found.values:
        value = dict(zip(found.names, row, strict=True))
        assert value["neck_inflow_mL_s_ratio"] == pytest.approx(1 - 100 / length_mm)
        alone, both = (value[f"straightened{what}_neck_inflow_mL_s_ratio"] for what in ("_bare", ""))
        assert 0.9 < alone < 1
        assert alone - both == pytest.approx(100 / length_mm)


class Known:
    """A flow by the length of the axis and the number of devices."""

    inflow_mL_s = 4.0

    def __init__(self, artery, devices):
        self.speed = artery.parent.axis.length_mm - 100 * devices
