"""The case handed to OpenFOAM: syntax, units, watertight patches, the flow that was asked for."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from foam_dictionary import parse
from shapes import sphere
from tubes import line, tube, with_neck

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.deployment.deploy import deploy
from vstent.deployment.struts import struts
from vstent.devices.catalogue import find_design
from vstent.errors import FlowError, InputError, LandingError
from vstent.flow.case import FlowCase, Sheet, Target
from vstent.flow.drag import COIL_INERTIA
from vstent.flow.openfoam.case import foam_case, strut_solids
from vstent.flow.openfoam.control import fluid
from vstent.flow.openfoam.cost import tell_cost
from vstent.flow.openfoam.dictionary import foam_file
from vstent.flow.openfoam.engine import OpenFoam
from vstent.flow.openfoam.patches import named_patches
from vstent.flow.openfoam.porous import BANDS, porous_files
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics
from vstent.flow.simulation import check_engine
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel

RADIUS_MM, BRANCH_MM, FLOW_ML_S = 2.0, 1.2, 3.0
SETUP = FoamSetup(0.25, processes=4)


@cache
def case(outlets: str = "zero_pressure", *, is_pulse: bool = False) -> FlowCase:
    straight = phantoms.tube(length_mm=14.0, radius_mm=RADIUS_MM)
    phantom = phantoms.with_branch(straight, abscissa_mm=6.0, direction=[1, 0, 1], radius_mm=BRANCH_MM, length_mm=11.0)
    vessel = trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.4)))
    waveform = OLDER_ADULT_ICA if is_pulse else None
    return vessel_case(vessel, FlowSettings(inflow_mL_s=FLOW_ML_S, outlets=outlets, waveform=waveform))


def with_sac() -> FlowCase:
    """The sac is whatever of the wall lies within a sphere: enough to name its faces."""
    lumen = case().vessel.lumen
    inside = np.linalg.norm(lumen.corners_mm.mean(axis=1) - [-RADIUS_MM, 0, 7.0], axis=1) < 1.5
    cut = Surface(lumen.vertices_mm, lumen.faces[inside])
    return replace(case(), target=Target(cut, sphere(1.0)))


@pytest.mark.parametrize("flavour", ["com", "org"])
@pytest.mark.parametrize("is_pulse", [False, True])
@pytest.mark.parametrize("outlets", ["zero_pressure", "murray"])
def test_every_dictionary_is_one(flavour: str, is_pulse: bool, outlets: str) -> None:
    foam = foam_case(case(outlets, is_pulse=is_pulse), replace(SETUP, flavour=flavour, struts=sphere(1.0)))
    parsed = {name: parse(text) for name, text in foam.files.items() if text.startswith("FoamFile")}
    for name, entries in parsed.items():
        assert entries["FoamFile"]["object"] == [name.rpartition("/")[2]]
    program = ["foamRun"] if flavour == "org" else ["pimpleFoam"] if is_pulse else ["simpleFoam"]
    assert parsed["system/controlDict"]["application"] == program
    patches = {"wall", "struts", "inlet", "outlet_1", "outlet_2"}
    for quantity in ("0/U", "0/p"):
        assert set(parsed[quantity]["boundaryField"]) == patches
    meshed = parsed["system/snappyHexMeshDict"]
    regions = meshed["geometry"]["lumen"]["regions"]
    assert set(regions) | {"struts"} == patches
    assert all(meshed["castellatedMeshControls"]["refinementSurfaces"]["lumen"]["regions"][name] for name in regions)
    assert set(meshed["addLayersControls"]["layers"]) == {"wall"}
    parts = parsed["system/decomposeParDict"]
    assert parts["numberOfSubdomains"] == ["4"]
    assert parts["hierarchicalCoeffs"]["n"] == ["(", "2", "1", "2", ")"]  # tube along z, branch along x and z
    viscosity = parsed["constant/" + ("physicalProperties" if flavour == "org" else "transportProperties")]["nu"]
    assert float(viscosity[-1]) == pytest.approx(0.004 / 1060)


@pytest.mark.parametrize(("cell_mm", "halved"), [(0.25, 0), (0.4, 1), (0.8, 2)])
def test_a_narrow_opening_gets_the_cells_that_keep_it_open(cell_mm: float, halved: int) -> None:
    foam = foam_case(case(), replace(SETUP, cell_size_mm=cell_mm))
    meshed = parse(foam.files["system/snappyHexMeshDict"])["castellatedMeshControls"]
    level = {name: int(one["level"][1]) for name, one in meshed["refinementSurfaces"]["lumen"]["regions"].items()}
    assert level["outlet_2"] - level["wall"] == halved
    assert 2 * BRANCH_MM / (cell_mm / 2**halved) >= 8 > (2 * BRANCH_MM / (cell_mm / 2 ** (halved - 1)) if halved else 0)
    assert ("before_outlet_2" in meshed["refinementRegions"]) == bool(halved)
    if halved:
        cylinder = parse(foam.files["system/snappyHexMeshDict"])["geometry"]["before_outlet_2"]
        first, last = (np.array(cylinder[point][1:4], dtype=float) * 1000 for point in ("point1", "point2"))
        opening = case().vessel.outlets[1]
        assert np.linalg.norm(np.cross(first - opening.center_mm, last - opening.center_mm)) < 1e-6
        assert np.linalg.norm(first - opening.center_mm) == pytest.approx(opening.diameter_mm, rel=1e-6)
        assert (last - opening.center_mm) @ (opening.center_mm - first) > 0


@pytest.mark.parametrize("flavour", ["com", "org"])
def test_blood_that_thins_has_its_law_in_openfoams_words(flavour: str) -> None:
    thin = Blood(1050.0, 0.00345, CarreauYasuda())
    files = {name: parse(text) for name, text in fluid(thin, replace(SETUP, flavour=flavour)).items()}
    com, org = files.get("transportProperties", {}), files.get("momentumTransport", {})
    law = org["laminar"] if org else com["BirdCarreauCoeffs"]
    nu0 = files["physicalProperties"]["nu"] if org else law["nu0"]
    assert law.get("viscosityModel", com.get("transportModel")) == ["BirdCarreau"]
    rest, high, k, n, a = (float(one[-1]) for one in (nu0, law["nuInf"], law["k"], law["n"], law["a"]))
    rate = np.array([0.0, 0.3, 5.0, 100.0, 1e4])
    found = high + (rest - high) * (1 + (k * rate) ** a) ** ((n - 1) / a)
    np.testing.assert_allclose(1050.0 * found, thin.viscosity_at_Pa_s(rate), rtol=1e-6)


def test_what_is_written_is_read_and_what_is_damaged_is_refused() -> None:
    text = foam_file("x", {"a_key_of_more_than_sixteen": 1.5, "b": {"c": ["d", (1, 2)], "e": True}}, note="why; {")
    entries = parse(text)
    assert entries["a_key_of_more_than_sixteen"] == ["1.5"]
    assert entries["b"] == {"c": ["(", "d", "(", "1", "2", ")", ")"], "e": ["yes"]}
    for damaged in (text.replace("1.5;", "1.5"), text[:-2], text + "}"):
        with pytest.raises(ValueError, match="OpenFOAM dictionary"):
            parse(damaged)


def test_the_patches_are_watertight_and_as_large_as_the_openings() -> None:
    patches, sections = named_patches(with_sac())
    surface = patches[0].surface
    assert sorted(np.concatenate([one.face_id for one in patches])) == list(range(len(surface.faces)))
    edges = np.concatenate([surface.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    there, back = ({tuple(edge) for edge in way} for way in (edges, edges[:, ::-1]))
    assert len(there) == len(edges)
    assert there == back
    assert surface.volume_mm3 > 0
    areas = {one.name: one.area_mm2 for one in patches}
    assert areas["sac"] == pytest.approx(with_sac().sac.area_mm2, rel=1e-9)
    for opening in case().vessel.openings:
        assert areas[opening.role] == pytest.approx(opening.area_mm2, rel=0.01)
    assert areas["inlet"] == pytest.approx(np.pi * RADIUS_MM**2, rel=0.01)
    assert sum(areas.values()) == pytest.approx(surface.area_mm2)
    assert len(sections) == 3


def solids(text: str) -> dict[str, np.ndarray]:
    """Corners (f, 3, 3) by solid of an ASCII STL."""
    found = {}
    for part in text.split("endsolid")[:-1]:
        name = part.split("solid ")[1].split()[0]
        rows = [line.split()[1:] for line in part.splitlines() if line.startswith("vertex")]
        found[name] = np.array(rows, dtype=float).reshape(-1, 3, 3)
    return found


def test_lengths_are_metres_and_solids_are_the_patches() -> None:
    foam = foam_case(with_sac(), SETUP)
    patches, _ = named_patches(with_sac())
    found = solids(foam.files["constant/triSurface/lumen.stl"])
    assert list(found) == [one.name for one in patches]
    for one in patches:
        np.testing.assert_allclose(found[one.name], one.corners_mm * 1e-3, atol=1e-10)
    assert list(solids(foam.files["constant/triSurface/ends.stl"])) == ["inlet", "outlet_1", "outlet_2"]
    everything = np.concatenate(list(found.values())).reshape(-1, 3)
    block = parse(foam.files["system/blockMeshDict"])
    corners = np.array([float(x) for x in block["vertices"] if x not in "()"]).reshape(-1, 3)
    assert (corners.min(axis=0) < everything.min(axis=0)).all()
    assert (corners.max(axis=0) > everything.max(axis=0)).all()
    counts = np.array([x for x in block["blocks"] if x not in "()"][9:12], dtype=int)
    np.testing.assert_allclose(np.ptp(corners, axis=0) / counts, 4 * 0.25e-3, rtol=1e-6)
    snappy = parse(foam.files["system/snappyHexMeshDict"])["castellatedMeshControls"]
    inside_mm = 1e3 * np.array([snappy["locationInMesh"][1:4]], dtype=float)
    assert patches[0].surface.signed_distance(inside_mm)[0] < -0.3


def vectors(text: str) -> np.ndarray:
    """All vectors (n, 3) of a text, one a line."""
    return np.array([line.strip("()").split() for line in text.splitlines() if line.count(" ") == 2], dtype=float)


def test_the_inlet_carries_the_flow_that_was_asked_for() -> None:
    files = foam_case(case(), SETUP).files
    points_m, velocity = (vectors(files[f"constant/boundaryData/inlet/{name}"]) for name in ("points", "0/U"))
    mean, velocity = velocity[-1], velocity[:-1]
    inlet = case().vessel.inlet
    area_m2 = next(one.area_mm2 for one in named_patches(case())[0] if one.name == "inlet") * 1e-6
    assert -mean @ inlet.normal * area_m2 == pytest.approx(FLOW_ML_S * 1e-6, rel=1e-6)
    # A parabola: twice the mean in the middle, zero at the wall and beyond.
    radius_m = np.linalg.norm(np.cross(points_m - inlet.center_mm * 1e-3, inlet.normal), axis=1)
    shape = -velocity @ inlet.normal / np.linalg.norm(mean)
    expected = np.maximum(2 * (1 - (radius_m / (RADIUS_MM * 1e-3)) ** 2), 0.0)
    np.testing.assert_allclose(shape, expected, atol=0.05)


def with_profile(profile: str, *, is_pulse: bool = False) -> FlowCase:
    inlet, *outlets = case(is_pulse=is_pulse).ends
    return replace(case(is_pulse=is_pulse), ends=(replace(inlet, profile=profile), *outlets))


def test_a_plug_is_uniform_in_both_dialects() -> None:
    com, org = (foam_case(with_profile("plug"), replace(SETUP, flavour=flavour)).files for flavour in ("com", "org"))
    speed = np.linalg.norm(vectors(com["constant/boundaryData/inlet/0/U"]), axis=1)
    np.testing.assert_allclose(speed[speed > 0], speed[-1])
    condition = parse(org["0/U"])["boundaryField"]["inlet"]
    assert condition["type"] == ["flowRateInletVelocity"]
    assert "profile" not in condition


def test_conditions_that_a_fork_of_openfoam_lacks_are_refused_before_it_meshes() -> None:
    assert (
        foam_case(with_profile("womersley"), SETUP).files == foam_case(case(), SETUP).files
    )  # the same in steady flow
    org = replace(SETUP, flavour="org")
    with pytest.raises(InputError, match="cannot have measured or Womersley profiles at its inlets: give"):
        foam_case(with_profile("womersley", is_pulse=True), org)
    with pytest.raises(InputError, match="cannot have resistances or Windkessels at its outlets: give"):
        foam_case(case("windkessel"), org)


@pytest.mark.parametrize(
    "settings", [FlowSettings(outlets="resistance"), FlowSettings(profile="womersley", waveform=OLDER_ADULT_ICA)]
)
def test_a_plug_in_without_these_ends_is_refused(settings: FlowSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    check_engine(settings)
    monkeypatch.setattr(OpenFoam, "has_all_ends", False)
    with pytest.raises(InputError, match="the engine openfoam does not support --"):
        check_engine(replace(settings, numerics=Numerics(engine="openfoam")))


def test_a_profile_that_pulsates_is_mapped_at_every_moment_of_all_cycles() -> None:
    files = foam_case(with_profile("womersley", is_pulse=True), SETUP).files
    period_s = OLDER_ADULT_ICA.period_s
    by_time = {float(name.split("/")[3]): name for name in files if name.endswith("/U") and "inlet/" in name}
    times_s = np.array(sorted(by_time))
    names = [by_time[time_s] for time_s in times_s.tolist()]
    np.testing.assert_allclose(times_s, period_s * np.arange(161) / 40, atol=1e-6)
    inlet, area_m2 = case().vessel.inlet, case().vessel.inlet.area_mm2 * 1e-6
    means = np.array([-vectors(files[name])[-1] @ inlet.normal for name in names]) * area_m2 * 1e6
    np.testing.assert_allclose(means, FLOW_ML_S * OLDER_ADULT_ICA.factor(times_s), rtol=0.02)
    first, again = (vectors(files[names[k]]) for k in (8, 48))
    np.testing.assert_allclose(first, again, atol=1e-6)
    condition = parse(files["0/U"])["boundaryField"]["inlet"]
    assert condition["type"] == ["timeVaryingMappedFixedValue"]


def test_resistances_prescribe_the_flow_without_a_device() -> None:
    files = foam_case(case("resistance"), SETUP).files
    velocity, pressure = (parse(files[f"0/{name}"])["boundaryField"] for name in ("U", "p"))
    assert pressure["outlet_1"]["type"] == ["fixedValue"]
    assert velocity["outlet_2"]["type"] == ["flowRateOutletVelocity"]
    asked = case("resistance").resistances[1].mean_mL_s
    np.testing.assert_allclose(pairs(files["constant/flow_outlet_2"])[:, 1], 1e-6 * asked)
    whole = [f"outlet_{k} {end.at(0.0):.4g}" for k, end in enumerate(case("resistance").resistances, start=1)]
    assert f"with a device, correct them by this formula. R in Pa s/mL: {', '.join(whole)}.\n" in files["README"]
    assert "resistances" not in foam_case(case(), SETUP).files["README"]


@pytest.mark.parametrize("is_pulse", [False, True])
def test_every_inlet_has_a_patch_and_a_profile_of_its_own(is_pulse: bool) -> None:
    former = case().vessel
    inlets_mm = np.array([former.openings[k].center_mm for k in (0, 2)])
    vessel = trace(replace(former, centerlines=()), inlet_mm=inlets_mm)
    waveform = OLDER_ADULT_ICA if is_pulse else None
    several = vessel_case(vessel, FlowSettings(inflow_mL_s=FLOW_ML_S, outlets="murray", waveform=waveform))
    com, org = (foam_case(several, replace(SETUP, flavour=flavour)).files for flavour in ("com", "org"))
    velocity, pressure = (parse(com[f"0/{name}"])["boundaryField"] for name in ("U", "p"))
    area_mm2 = {one.name: one.area_mm2 for one in named_patches(several)[0]}
    cubes = np.array([inlet.diameter_mm**3 for inlet in several.vessel.inlets])
    for inlet, flow_mL_s in zip(several.vessel.inlets, FLOW_ML_S * cubes / cubes.sum(), strict=True):
        mean_m_s = -vectors(com[f"constant/boundaryData/{inlet.role}/0/U"])[-1] @ inlet.normal
        assert mean_m_s * area_mm2[inlet.role] == pytest.approx(flow_mL_s, rel=1e-6)
        assert velocity[inlet.role]["type"] == ["scaledFixedValue" if is_pulse else "timeVaryingMappedFixedValue"]
        assert pressure[inlet.role] == {"type": ["zeroGradient"]}
        flow = parse(org["0/U"])["boundaryField"][inlet.role]["volumetricFlowRate"]
        if is_pulse:
            assert pairs(com[f"constant/flow_{inlet.role}"])[0, 1] == pytest.approx(OLDER_ADULT_ICA.factor(0.0))
            flow_mL_s *= OLDER_ADULT_ICA.factor(0.0)
            assert pairs(" ".join(flow["values"]))[0, 1] == pytest.approx(flow_mL_s * 1e-6)
        else:
            assert float(flow[1]) == pytest.approx(flow_mL_s * 1e-6)
    assert "Patches: wall, inlet, inlet_2, outlet_1, ..." in com["README"]


def pairs(text: str) -> np.ndarray:
    """A table (t, 2) of time and value."""
    return np.array(text.replace("(", " ").replace(")", " ").split(), dtype=float).reshape(-1, 2)


def test_a_pulse_repeats_and_keeps_its_mean() -> None:
    foam = foam_case(case("murray", is_pulse=True), SETUP).files
    com = parse(foam["0/U"])["boundaryField"]
    org = parse(foam_case(case("murray", is_pulse=True), replace(SETUP, flavour="org")).files["0/U"])["boundaryField"]
    for patch, key in (("inlet", "scale"), ("outlet_2", "volumetricFlowRate")):
        assert com[patch][key] == ["tableFile"]
        assert com[patch][f"{key}Coeffs"] == {"file": [f'"<constant>/flow_{patch}"'], "outOfBounds": ["repeat"]}
    time_s, factor = pairs(foam["constant/flow_inlet"]).T
    assert (time_s[0], time_s[-1]) == (0.0, OLDER_ADULT_ICA.period_s)
    np.testing.assert_allclose(factor, OLDER_ADULT_ICA.factor(time_s), rtol=1e-8)
    assert factor[:-1].mean() == pytest.approx(1.0, abs=1e-8)
    flow = org["inlet"]["volumetricFlowRate"]
    assert (flow["type"], flow["outOfBounds"]) == (["table"], ["repeat"])
    np.testing.assert_allclose(pairs(" ".join(flow["values"]))[:, 1], FLOW_ML_S * 1e-6 * factor, rtol=1e-8)
    cubes = np.array([outlet.diameter_mm**3 for outlet in case().vessel.outlets])
    out = pairs(foam["constant/flow_outlet_2"])[:, 1]
    np.testing.assert_allclose(out, FLOW_ML_S * 1e-6 * factor * cubes[1] / cubes.sum(), rtol=1e-8)
    steady = parse(foam_case(case("murray"), SETUP).files["0/U"])["boundaryField"]["outlet_2"]["volumetricFlowRate"]
    assert float(steady[1]) == pytest.approx(FLOW_ML_S * 1e-6 * cubes[1] / cubes.sum())
    control = parse(foam_case(case("murray", is_pulse=True), SETUP).files["system/controlDict"])
    assert float(control["endTime"][0]) == pytest.approx(4 * OLDER_ADULT_ICA.period_s)


def test_a_region_of_coils_becomes_nested_zones_with_its_resistance() -> None:
    """Every sample lies in the zone of its resistance, and d and f are the means there."""
    steps = np.argwhere(np.linalg.norm(np.indices((21, 21, 21)) - 10, axis=0) < 9.0)
    points_mm, alike = 0.15 * steps + [5.0, 0.0, 0.0], np.ones(len(steps))
    depth = np.linalg.norm(steps - 10, axis=1)
    permeability_mm2 = 0.004 * (1 + depth)  # denser inside
    viscous = Blood().viscosity_Pa_s / (permeability_mm2 * 1e-3)
    loss = 4 * COIL_INERTIA * 0.3 / permeability_mm2
    region = Sheet(points_mm, np.zeros((len(steps), 3)), 0.15**3 * alike, viscous, viscous, loss, alike, alike)
    coiled = replace(case(), media=(region,))
    assert strut_solids(coiled) is None
    for flavour, name in (("com", "fvOptions"), ("org", "fvModels")):
        setup = FoamSetup(0.2, flavour)
        files, surfaces = porous_files(coiled, setup)
        assert set(files) == {"system/topoSetDict", f"constant/{name}"}
        assert "topoSet" in foam_case(coiled, setup).files["Allrun"]
    zones = []
    for name, solids in surfaces.items():
        vertices_mm, at = np.unique(solids[name].reshape(-1, 3).round(6), axis=0, return_inverse=True)
        zones.append(Surface(vertices_mm, at.reshape(-1, 3)))
    assert not any(zone.boundary_loops for zone in zones)
    inside = np.array([zone.signed_distance(points_mm) < 0 for zone in zones])
    number = inside.sum(axis=0) - 1
    assert (np.diff(inside.astype(int), axis=0) <= 0).all()
    assert number.min() == 0
    models = parse(files["constant/fvModels"])
    for band in range(BANDS):
        told = models[f"coils_{band + 1}"]["porosityForceCoeffs"]
        darcy = (1e6 / permeability_mm2[number == band]).mean()
        assert float(told["d"][1]) == pytest.approx(darcy, rel=0.03)
        assert float(told["f"][1]) == pytest.approx(2 * COIL_INERTIA * 0.3e-3 * darcy, rel=0.03)
    assert "topoSet" not in foam_case(case(), FoamSetup(0.2)).files["Allrun"]


def test_a_device_is_meshed_by_its_wires_over_an_ostium_or_refused() -> None:
    healthy = tube(line(32), 1.9)
    branched = replace(with_neck(healthy, 14, 18), aneurysms=())
    stent = deploy(find_design("enterprise"), healthy).stent
    solids = strut_solids(flow_case(branched, (stent,)))
    assert solids is not None
    assert 0 < solids.volume_mm3 < 0.3 * struts(stent).volume_mm3
    assert strut_solids(flow_case(branched, ())) is None
    both = flow_case(branched, (stent, stent))
    assert len(both.media) == len(both.solids) == 2
    two = strut_solids(both)
    assert two is not None
    assert two.volume_mm3 == pytest.approx(2 * solids.volume_mm3)
    assert tell_cost(both, 0.2) != tell_cost(flow_case(branched, (stent,)), 0.2)
    with pytest.raises(LandingError, match="over a neck or a branch's ostium"):
        strut_solids(flow_case(healthy, (stent,)))
    with pytest.raises(FlowError, match="give the stent itself"):
        strut_solids(replace(flow_case(branched, (stent,)), solids=()))


@pytest.mark.parametrize(("name", "across_mm"), [("silk", (0.030, 0.050)), ("enterprise", (0.078, 0.078))])
def test_two_cells_lie_across_a_strut_and_no_more_than_twice_as_many(name: str, across_mm: tuple[float, float]) -> None:
    anatomy = tube(line(26), 1.9)
    setup = FoamSetup(0.25, struts=struts(deploy(find_design(name), anatomy).stent))
    cell_mm = 0.25 / 2**setup.levels_at_struts
    assert across_mm[0] / 5 < cell_mm < across_mm[1] / 2
    assert FoamSetup(0.25).levels_at_struts == 0


def test_what_struts_cost_is_told_and_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    branched = replace(with_neck(tube(line(32), 1.9), 14, 18), aneurysms=())
    cases = [flow_case(branched, (deploy(find_design(name), branched).stent,)) for name in ("silk", "enterprise")]
    for stented, times in zip(cases, (4.0, 2.0), strict=True):
        bare, told = tell_cost(replace(stented, media=(), solids=()), 0.2), tell_cost(stented, 0.2)
        assert "struts" not in bare
        assert told.startswith(bare.split(",")[0])
        assert _thousands(told) > times * _thousands(bare)
    silk = cases[0]
    monkeypatch.setattr("vstent.flow.openfoam.cost.free_memory_bytes", lambda: 1.2e9)
    with pytest.raises(FlowError, match=r"million cells at .* 0.2 mm needs .* set a grid spacing of") as refusal:
        tell_cost(silk, 0.2)
    fitting_mm = float(str(refusal.value).split("set a grid spacing of ")[1].split(" mm")[0])
    assert 0.2 < fitting_mm < 0.4
    tell_cost(silk, fitting_mm)
    monkeypatch.setattr("vstent.flow.openfoam.cost.free_memory_bytes", lambda: 4e8)
    with pytest.raises(FlowError, match="choose the engine lattice_boltzmann"):
        tell_cost(silk, 0.2)


def _thousands(told: str) -> float:
    """All cells of which a sentence on cost tells, in thousands."""
    return sum(float(number.replace(",", "")) for number in re.findall(r"([\d,]+) thousand", told))
