"""The engine that hands the flow to OpenFOAM: meshes, computes from check to check, reads the fields back.

The finite volumes of OpenFOAM are of any shape; what is returned lies on the same regular grid as the embedded engine's
flow, so that every index, streamline and picture takes either.
"""

import hashlib
import re
import shutil
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np
from scipy.sparse import csr_matrix

from vstent.errors import FlowError
from vstent.flow import domain as domains
from vstent.flow import sampling
from vstent.flow.engines import AbstractEngine, Outcome
from vstent.flow.engines.lattice_boltzmann import CHECKS_AGREEING, CHECKS_AVERAGED, fraction_left
from vstent.flow.engines.lattice_pulse import PHASES, cycle_change
from vstent.flow.openfoam import program, results, scatter
from vstent.flow.openfoam.case import FoamCase, foam_case
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.types import FlowCase, FlowField, Phase
from vstent.kernels.arrays import Floats, Ints
from vstent.surface import Surface
from vstent.units import M3_PER_ML, M_PER_MM

CHECK_ITERATIONS: Final = 20
"""Iterations of a steady flow between checks."""
KEY: Final = "vstent.key"
"""File that names what a folder's run depends on."""
PRODUCTS: Final = ("constant/polyMesh", "postProcessing", "processor*", "log.*", "[1-9]*", "0.[0-9]*", "0", KEY)
"""What a run leaves in a case folder."""


@dataclass(frozen=True, eq=False)
class Bridge:
    """From OpenFOAM's cells and faces to the grid, the ostium and the wall."""

    velocity: csr_matrix
    """(n, s) cells, then faces of the patches that hold their velocity -> grid cells."""
    pressure: csr_matrix
    """(n, c) cells -> grid cells."""
    ostium: csr_matrix
    """(o, s) -> points on the ostium."""
    wall: csr_matrix
    """(v, f) faces of the walls -> vertices of the lumen."""
    wall_pressure: csr_matrix
    """(v, c) cells -> vertices of the lumen."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The flow at a check, in SI units."""

    time: str
    """Its name: iterations, or seconds."""
    velocity_m_s: Floats
    """(n, 3) in the grid's cells."""
    pressure_Pa: Floats
    """(n,) in the grid's cells."""
    wall_shear_stress_Pa: Floats
    """(v, 3) at the lumen's vertices."""
    wall_pressure_Pa: Floats
    """(v,) at the lumen's vertices."""
    outflow_mL_s: Floats
    """(k,) through every opening."""


@dataclass(eq=False)
class State:
    """A run under way in a folder; its files change."""

    case: FlowCase
    """What is computed."""
    setup: FoamSetup
    """How."""
    foam: FoamCase
    """The case folder's files."""
    found: program.Program
    """OpenFOAM."""
    folder: Path
    """The case folder."""
    domain: domains.Domain
    """The grid of the result."""
    bridge: Bridge
    """From one to the other."""
    sac_cells: Ints
    """Cells of the sac, or of the whole lumen where there is none."""
    ostium_area_mm2: Floats
    """(o, 3) area vectors of the points on the ostium."""
    cells: int
    """Cells of OpenFOAM's mesh."""
    snapshots: deque[Snapshot]
    """The flow at the last checks."""
    is_settled: bool = False
    """Whether the solver's own residuals are below their limits."""
    history: list[Floats] = field(default_factory=list)
    """Monitored quantities at every check."""
    loop_seconds: float = 0.0
    """Time in the solver."""


@dataclass(frozen=True)
class OpenFoam(AbstractEngine[State]):
    """OpenFOAM's laminar solvers on a mesh by snappyHexMesh: simpleFoam, or pimpleFoam along a waveform."""

    cell_size_mm: float
    """Edge of a cell of OpenFOAM's mesh in the vessel, before layers and refinement."""
    folder: Path
    """Case folder; a run of the same case that stopped there goes on from the last time written."""
    processes: int = 1
    """Processes on this machine."""
    struts: Surface | None = None
    """Solids of a device to mesh."""
    layers: int = 2
    """Layers of flat cells along the wall."""
    grid_size_mm: float | None = None
    """Edge of a cell of the result's grid; None: as OpenFOAM's."""

    def init(self, case: FlowCase, start: FlowField | None) -> State:
        """Find OpenFOAM, write the case, mesh it, and find the way from its cells to the grid."""
        if case.screen is not None:
            raise FlowError(
                "OpenFOAM has no porous law that turns with the screen from cell to cell: mesh the device's struts, or "
                "take the embedded engine"
            )
        found = program.find()
        setup = FoamSetup(
            self.cell_size_mm, found.flavour, self.layers, processes=self.processes, struts=self.struts
        )
        foam = foam_case(case, setup)
        _prepare(self.folder, foam)
        _mesh(found, self.folder, setup)
        domain = domains.build(case.vessel, self.grid_size_mm or self.cell_size_mm)
        samples_mm, area_mm2 = _ostium_samples(case, domain.cell_size_mm)
        centers = results.read_field(self.folder, "0", "C")
        if start is not None and not results.times(self.folder):
            _begin_from(self.folder, start)
        sac = np.arange(len(domain.cells), dtype=np.int32)
        if case.sac is not None:
            sac = domains.cells_inside(case.sac, domain.centers_mm, domain.cell_size_mm)
        bridge = _bridge(case, domain, centers, samples_mm)
        kept = PHASES if case.settings.waveform else CHECKS_AVERAGED
        count = len(centers.inside)
        return State(
            case, setup, foam, found, self.folder, domain, bridge, sac, area_mm2, count, deque(maxlen=kept)
        )

    def step(self, state: State) -> State:
        """Run the solver to the next check and read what it wrote."""
        began = perf_counter()
        reached = results.times(state.folder)
        end = _next_end(state, float(reached[-1]) if reached else 0.0)
        _set_end(state, end)
        said = program.run(state.found, state.folder, [state.foam.application], processes=state.setup.processes)
        state.loop_seconds += perf_counter() - began
        state.is_settled = "solution converged" in said
        state.snapshots.append(_read(state, results.times(state.folder)[-1]))
        state.history.append(_monitor(state, state.snapshots[-1]))
        _hold_inflow(state)
        return state

    def terminate(self, state: State) -> float:
        """Fraction that the monitored quantities have left to go, or the change from cycle to cycle."""
        history = np.array(state.history)
        if not np.isfinite(history[-1]).all():
            return float("nan")
        if state.case.settings.waveform is not None:
            return cycle_change(history)
        if state.is_settled:
            return 0.0
        return max(fraction_left(history[: len(history) - k]) for k in range(min(CHECKS_AGREEING, len(history))))

    def max_checks(self, state: State) -> int:
        """Checks within the limit of iterations, or phases of all cycles."""
        if state.case.settings.waveform is not None:
            return PHASES * state.case.settings.max_cycles
        return state.setup.iterations // CHECK_ITERATIONS

    def result(self, state: State, outcome: Outcome) -> FlowField:
        """Return the last check, the mean of the last ones where the flow has not settled, or that of the last cycle."""
        is_pulse = state.case.settings.waveform is not None
        kept = [state.snapshots[-1]] if outcome.is_converged and not is_pulse else list(state.snapshots)
        return _field_of(state, kept, outcome, is_pulse=is_pulse)


def _prepare(folder: Path, foam: FoamCase) -> None:
    """Write the case's files, unless the same case lies there already; what another left is taken away."""
    digest = hashlib.sha256("".join(f"{name}\0{text}\0" for name, text in sorted(foam.files.items())).encode())
    key = folder / KEY
    if key.exists() and key.read_text() == digest.hexdigest():
        return
    for pattern in PRODUCTS:
        for path in folder.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name, text in foam.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")
        path.chmod(0o755 if name in foam.executable else 0o644)
    key.write_text(digest.hexdigest())


def _mesh(found: program.Program, folder: Path, setup: FoamSetup) -> None:
    """Mesh and cut into parts, unless that has been done."""
    done = folder / "log.done"
    if done.exists():
        return
    features = "surfaceFeatures" if found.flavour == "org" else "surfaceFeatureExtract"
    for words in ([features], ["blockMesh"], ["snappyHexMesh", "-overwrite"], ["renumberMesh", "-overwrite"]):
        program.run(found, folder, words)
    if setup.processes > 1:
        program.run(found, folder, ["decomposePar", "-force"])
    words = ["postProcess", "-func", "writeCellCentres", "-time", "0"]
    program.run(found, folder, words, processes=setup.processes)
    done.write_text("meshed\n")


def _ostium_samples(case: FlowCase, cell_size_mm: float) -> tuple[Floats, Floats]:
    if case.ostium is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    return sampling.surface_samples(case.ostium, cell_size_mm)


def _begin_from(folder: Path, start: FlowField) -> None:
    """Put a flow on any grid into the first velocity and pressure."""
    for part in list(folder.glob("processor[0-9]*")) or [folder]:
        centers_mm = results.read_field(part, "0", "C").inside / M_PER_MM
        velocity_m_s, pressure_Pa = sampling.values_at(start, centers_mm)
        kinematic = pressure_Pa[:, None] / start.blood.density_kg_m3
        for name, kind, values in (("U", "vector", velocity_m_s), ("p", "scalar", kinematic)):
            rows = "\n".join(("(%.7g %.7g %.7g)" if kind == "vector" else "%.7g") % tuple(row) for row in values)
            listed = f"internalField nonuniform List<{kind}>\n{len(values)}\n(\n{rows}\n)\n;"
            path = part / "0" / name
            path.write_text(re.sub(r"internalField\s+uniform [^;]*;", lambda _, text=listed: text, path.read_text(), count=1))


def _bridge(case: FlowCase, domain: domains.Domain, centers: results.VolumeField, ostium_mm: Floats) -> Bridge:
    inside_mm = centers.inside / M_PER_MM
    held = [centers.patches[name] / M_PER_MM for name in _held(centers)]
    known_mm = np.concatenate([inside_mm, *held])
    walls_mm = np.concatenate([centers.patches[name] for name in _walls(centers)]) / M_PER_MM
    wall_mm, lumen = case.vessel.lumen.vertices_mm, case.vessel.lumen
    # Points of two walls back to back lie near each other, but their normals do not.
    reach_mm = 2 * domain.cell_size_mm
    facing = lumen.normals[lumen.closest(walls_mm)[2]]
    return Bridge(
        scatter.linear_fits(known_mm, domain.centers_mm),
        scatter.linear_fits(inside_mm, domain.centers_mm),
        scatter.linear_fits(known_mm, ostium_mm),
        scatter.near_means(
            np.hstack([walls_mm, reach_mm * facing]), np.hstack([wall_mm, reach_mm * lumen.vertex_normals]), reach_mm
        ),
        scatter.linear_fits(inside_mm, wall_mm),
    )


def _walls(centers: results.VolumeField) -> list[str]:
    return [name for name in ("wall", "sac", "struts") if name in centers.patches]


def _held(centers: results.VolumeField) -> list[str]:
    """Patches whose velocity is known: at rest, or the inlet's."""
    return [*_walls(centers), "inlet"]


def _next_end(state: State, reached: float) -> float:
    waveform = state.case.settings.waveform
    if waveform is None:
        return reached + CHECK_ITERATIONS
    phase_s = waveform.period_s / PHASES
    return (round(reached / phase_s) + 1) * phase_s


def _set_end(state: State, end: float) -> None:
    """Let the solver stop, and write, at a time."""
    path = state.folder / "system" / "controlDict"
    text = re.sub(r"endTime .*;", f"endTime         {end:.9g};", path.read_text())
    if state.case.settings.waveform is None:
        text = re.sub(r"writeInterval   \d.*;", f"writeInterval   {CHECK_ITERATIONS};", text, count=1)
    path.write_text(text)


def _read(state: State, time: str) -> Snapshot:
    """Fields of a time on the grid and on the wall."""
    density, bridge, folder = state.case.blood.density_kg_m3, state.bridge, state.folder
    velocity = results.read_field(folder, time, "U")
    centers = results.read_field(folder, "0", "C")
    pressure_Pa = density * results.read_field(folder, time, "p").inside[:, 0]
    rest = [np.zeros((len(centers.patches[name]), 3)) for name in _walls(centers)]
    known = np.concatenate([velocity.inside, *rest, velocity.patches["inlet"]])
    stress = results.read_field(folder, time, "wallShearStress").patches
    # OpenFOAM's is what the wall does to the blood, over density.
    stress_Pa = -density * np.concatenate([stress[name] for name in _walls(centers)])
    traction_Pa = bridge.wall @ stress_Pa
    normal = state.case.vessel.lumen.vertex_normals
    return Snapshot(
        time,
        bridge.velocity @ known,
        bridge.pressure @ pressure_Pa,
        traction_Pa - np.einsum("ij,ij->i", traction_Pa, normal)[:, None] * normal,
        bridge.wall_pressure @ pressure_Pa,
        np.array([_flow_mL_s(folder, opening.role) for opening in state.case.vessel.openings]),
    )


def _flow_mL_s(folder: Path, name: str) -> float:
    """Last flow out through a patch that the function objects noted."""
    files = sorted((folder / "postProcessing" / f"flow_{name}").glob("*/*.dat"), key=lambda path: path.stat().st_mtime_ns)
    last = files[-1].read_text().splitlines()[-1].split()
    return float(last[1]) / M3_PER_ML


def _monitor(state: State, now: Snapshot) -> Floats:
    """Mean speed of the sac, pressure at the inlet, mean speed of the vessel, neck inflow: as the embedded engine."""
    speed = np.linalg.norm(now.velocity_m_s, axis=1)
    inlet = state.domain.link_cell[state.domain.link_patch == 1]
    values = [speed[state.sac_cells].mean(), now.pressure_Pa[inlet].mean(), speed.mean()]
    if len(state.ostium_area_mm2):
        velocity = results.read_field(state.folder, now.time, "U")
        centers = results.read_field(state.folder, "0", "C")
        rest = [np.zeros((len(centers.patches[name]), 3)) for name in _walls(centers)]
        through = state.bridge.ostium @ np.concatenate([velocity.inside, *rest, velocity.patches["inlet"]])
        values.append(float(np.maximum(np.einsum("ij,ij->i", through, state.ostium_area_mm2), 0.0).sum()))
    return np.array(values, dtype=float)


def _hold_inflow(state: State) -> None:
    """Correct the inlet's mean speed for its meshed area, which is a little less than the section's."""
    path = state.folder / "constant" / "boundaryData" / "inlet" / "0" / "U"
    if state.case.settings.waveform is not None or not path.exists() or len(state.history) > 2:
        return
    scale = -state.case.inflow_mL_s / state.snapshots[-1].outflow_mL_s[0]
    if abs(scale - 1) < 1e-5:
        return
    lines = path.read_text().splitlines()
    mean = scale * np.array(lines[-1].strip("()").split(), dtype=float)
    path.write_text("\n".join([*lines[:-1], "(" + " ".join(f"{x:.9g}" for x in mean) + ")"]) + "\n")
    state.is_settled = False


def _field_of(state: State, kept: list[Snapshot], outcome: Outcome, *, is_pulse: bool) -> FlowField:
    def mean(name: str) -> Floats:
        return np.mean([getattr(one, name) for one in kept], axis=0)

    vessel, domain = state.case.vessel, state.domain
    pressure_Pa, outflow_mL_s = mean("pressure_Pa"), mean("outflow_mL_s")
    section_Pa = np.array([_section_pressure_Pa(state, pressure_Pa, k) for k in range(len(vessel.openings))])
    phases = [
        Phase(float(one.time), -float(one.outflow_mL_s[0]), one.velocity_m_s, one.pressure_Pa, one.wall_shear_stress_Pa)
        for one in kept
    ]
    steps = len(state.history) * (1 if is_pulse else CHECK_ITERATIONS)
    return FlowField(
        cells=domain.cells,
        origin_mm=domain.origin_mm,
        cell_size_mm=domain.cell_size_mm,
        velocity_m_s=mean("velocity_m_s"),
        pressure_Pa=pressure_Pa,
        wall=vessel.lumen,
        wall_shear_stress_Pa=mean("wall_shear_stress_Pa"),
        wall_pressure_Pa=mean("wall_pressure_Pa"),
        inlet_mL_s=-outflow_mL_s[0],
        outlets_mL_s=outflow_mL_s[1:],
        inlet_pressure_Pa=section_Pa[0],
        outlet_pressure_Pa=section_Pa[1:],
        blood=state.case.blood,
        is_converged=outcome.is_converged,
        advice=_advice(state, outcome, is_pulse=is_pulse),
        residual=np.array(outcome.residual),
        steps=steps,
        seconds=outcome.seconds,
        updates_per_s=state.cells * steps / max(state.loop_seconds, 1e-9),
        phases=tuple(phases) if is_pulse else (),
    )


def _section_pressure_Pa(state: State, pressure_Pa: Floats, k: int) -> float:
    """Mean pressure of the cells on the plane of opening k itself, not of its extension's end."""
    opening = state.case.vessel.openings[k]
    offset = state.domain.centers_mm - opening.center_mm
    near = np.abs(offset @ opening.normal) < state.domain.cell_size_mm
    near &= np.linalg.norm(offset, axis=1) < 0.75 * opening.diameter_mm
    return float(pressure_Pa[near].mean()) if near.any() else float("nan")


def _advice(state: State, outcome: Outcome, *, is_pulse: bool) -> str:
    mesh = f"OpenFOAM on {state.cells} cells ({state.folder})."
    if is_pulse:
        cycles = len(state.history) // PHASES
        return f"Cycle {cycles} repeats the one before to within {100 * outcome.residual[-1]:.1f} %. {mesh}"
    if outcome.is_converged:
        return f"The flow has settled. {mesh}"
    return (
        f"The steady solver has not settled in {state.setup.iterations} iterations: the flow may be unsteady by nature; "
        f"follow it in time with a waveform. {mesh}"
    )
