"""Study: one patient, from a file to the flow before and after, with its files, its provenance and its resume.

The stages follow each other as in design.md section 1. Geometry is computed first and nothing is written until every
device is deployed, so that a wrong input leaves nothing behind. From then on each finished stage lies in the folder
under a key that names everything it depends on; running the same study again reads it back instead of computing it.
"""

import hashlib
import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any, Final, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vstent.deploy import deploy, propose_size
from vstent.device import Design, Size, find_design, find_size
from vstent.errors import ReadError
from vstent.flow import FlowField, FlowSettings, compare, flow_case, indices, ostium, simulate_case
from vstent.flow import Progress as FlowProgress
from vstent.io import writers
from vstent.io.archive import load_noun, save_noun
from vstent.io.files import is_surface_file
from vstent.io.images import read_image
from vstent.io.surfaces import read_surface
from vstent.kernels.arrays import Floats
from vstent.measure import measure, morphology
from vstent.repair import repair
from vstent.restore import restore
from vstent.segment import segment
from vstent.stent import Deployment, Landing
from vstent.struts import struts
from vstent.trace import trace
from vstent.trim import trim
from vstent.vessel import Anatomy, Centerline, Vessel

PACKAGES: Final = ("vstent", "numpy", "scipy", "numba", "vtk", "SimpleITK", "pydicom")
CACHE: Final = ".vstent"
"""Folder inside the case folder that holds finished stages."""
BARE: Final = "bare"

Noun = TypeVar("Noun")
Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Settings:
    """Everything that a study may be told; None means that it is proposed."""

    devices: tuple[str, ...] = ("silk", "enterprise")
    """Names in the catalogue."""
    units: Literal["m", "cm", "mm"] | None = None
    """Length unit of a surface file."""
    spacing_mm: Point | None = None
    """Voxel edges of a raw volume."""
    shape: tuple[int, int, int] | None = None
    """Voxel counts of a raw volume."""
    threshold: float | None = None
    """Intensity of the lumen's wall in a scan."""
    at_mm: Point | None = None
    """A point near the sac."""
    inlet_mm: Point | None = None
    """A point near the inlet."""
    outlet_mm: Point | None = None
    """A point near the outlet that the parent artery leads to."""
    diameter_mm: float | None = None
    """Label diameter of the devices."""
    length_mm: float | None = None
    """Label length of the devices."""
    center_mm: float | None = None
    """Abscissa on the parent axis where the middle of the device is to lie."""
    flow: FlowSettings | None = field(default_factory=FlowSettings)
    """How to compute the flow; None: not at all."""


class Progress(Protocol):
    """Told what a study does."""

    def __call__(self, stage: str, fraction: float, detail: str) -> None:
        """`stage` has come to `fraction` (1: done); `detail` says what was found, or how long is left."""


@dataclass(frozen=True, eq=False)
class CaseResult:
    """All that a study found."""

    name: str
    """The case folder's name (a scan's own name may be the patient's)."""
    anatomy: Anatomy
    """Vessel, parent artery, sacs."""
    deployments: dict[str, Deployment]
    """By device name."""
    fields: dict[str, FlowField]
    """``bare``, then by device name; empty where flow was not asked for."""
    metrics: dict[str, Any]
    """``vessel``, ``bare``, ``stents.NAME.{deployment,flow,ratios}``; every number's key ends in its unit."""
    provenance: dict[str, Any]
    """Versions, inputs with hashes, settings, seconds per stage."""
    notes: tuple[str, ...]
    """What was found, guessed or repaired, one sentence each."""


def run(path: Path, out: Path, settings: Settings, progress: Progress) -> CaseResult:
    """Run one study and write its folder; a study already begun there goes on where it stopped.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : what is given; the rest is proposed.
    progress : told of every stage.

    Raises
    ------
    InputError
        Something given cannot be used; nothing has been written.
    FlowError
        A flow could not be computed; everything before it is kept.
    """
    designs = {name: find_design(name) for name in settings.devices}
    ledger = _Ledger(out / CACHE, progress)
    source = _hash_of(path)
    anatomy_key = _anatomy_key(source, settings)
    anatomy = ledger.recall("anatomy", anatomy_key, Anatomy) or _anatomy(path, settings, ledger)
    deployments = {}
    for name, design in designs.items():
        with ledger.stage(f"deploy {name}") as tell:
            deployments[name] = _deploy(design, anatomy, settings)
            tell(deployments[name].advice)
    ledger.keep("anatomy", anatomy_key, anatomy)
    _write_anatomy(out, anatomy)
    for name, deployment in deployments.items():
        with ledger.stage(f"struts {name}") as tell:
            tell(_write_stent(out / "stents" / name, deployment))
    fields = _flows(out, anatomy, deployments, settings, ledger, anatomy_key)
    with ledger.stage("measure"):
        metrics = _metrics(anatomy, deployments, fields)
        writers.write_json(out / "metrics.json", metrics)
    provenance = _provenance(path, source, settings, ledger)
    writers.write_json(out / "run.json", provenance)
    notes = (*anatomy.vessel.notes, *anatomy.notes)
    return CaseResult(out.resolve().name, anatomy, deployments, fields, metrics, provenance, notes)


def trace_vessel(path: Path, out: Path, settings: Settings, progress: Progress) -> Vessel:
    """Find the vessel, its openings and its centerlines, untrimmed; write them into the folder `out`.

    Parameters
    ----------
    path : a scan or a surface.
    out : the folder.
    settings : what is given; the rest is proposed.
    progress : told of every stage.

    Raises
    ------
    InputError
        Something given cannot be used; nothing has been written.
    """
    _refuse_missing(path)
    vessel = _traced(path, settings, _Ledger(out / CACHE, progress))
    _write_vessel(out, vessel)
    return vessel


def restore_vessel(path: Path, out: Path, settings: Settings, progress: Progress) -> tuple[Anatomy, dict[str, Any]]:
    """Shrink the sac: find the parent artery and measure it; write it into the folder `out`.

    A study begun in the same folder goes on from what is found here, and the other way round.

    Parameters
    ----------
    path : a scan or a surface.
    out : the case folder.
    settings : what is given; the rest is proposed.
    progress : told of every stage.

    Raises
    ------
    InputError
        Something given cannot be used; nothing has been written.
    """
    ledger = _Ledger(out / CACHE, progress)
    key = _anatomy_key(_hash_of(path), settings)
    anatomy = ledger.recall("anatomy", key, Anatomy) or _anatomy(path, settings, ledger)
    measures = morphology(anatomy)
    ledger.keep("anatomy", key, anatomy)
    _write_anatomy(out, anatomy)
    writers.write_json(out / "morphology.json", measures)
    return anatomy, measures


class _Ledger:
    """Times the stages, tells of them, and keeps what they found under keys of what they depend on."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.folder, self.progress = folder, progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[str], None]]:
        """Announce a stage, time it, and say what it found (the yielded function takes the sentence)."""
        found: list[str] = []
        self.progress(name, 0.0, "")
        began = time.perf_counter()
        yield found.append
        self.seconds[name] = time.perf_counter() - began
        self.progress(name, 1.0, " ".join(found))

    def teller(self, name: str) -> Callable[[FlowProgress], None]:
        """Return what a flow engine tells its progress to."""

        def tell(progress: FlowProgress) -> None:
            fraction = min(progress.fraction, 0.99)
            settling = f"{progress.residual:.1%} left to settle, " if isfinite(progress.residual) else ""
            self.progress(name, fraction, f"{settling}{progress.seconds_left:.0f} s left")

        return tell

    def recall(self, name: str, key: str, noun_type: type[Noun]) -> Noun | None:
        """Return what was kept under this key; None where it is missing or damaged."""
        path = self.folder / f"{name}-{key}.npz"
        if not path.exists():
            return None
        try:
            with self.stage(name) as tell:
                noun = load_noun(path, noun_type)
                tell("already done")
        except ReadError:
            return None
        return noun

    def keep(self, name: str, key: str, noun: Any) -> None:
        """Keep a noun under a key; what was kept under the same name before is dropped."""
        path = self.folder / f"{name}-{key}.npz"
        if path.exists():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        stale = list(self.folder.glob(f"{name}-*.npz"))
        save_noun(path, noun)
        for old in stale:
            old.unlink()


def _anatomy(path: Path, settings: Settings, ledger: _Ledger) -> Anatomy:
    """Read, segment, repair, trace, trim and restore."""
    whole = _traced(path, settings, ledger)
    with ledger.stage("trim") as tell:
        traced = trim(whole, at_mm=_array(settings.at_mm))
        tell(" ".join(traced.notes[len(whole.notes) :]))
    with ledger.stage("restore") as tell:
        anatomy = restore(traced, at_mm=_array(settings.at_mm), outlet_mm=_array(settings.outlet_mm))
        tell(" ".join([*anatomy.notes, *(f"Sac of {a.sac.volume_mm3:.0f} mm3." for a in anatomy.aneurysms)]))
    return anatomy


def _traced(path: Path, settings: Settings, ledger: _Ledger) -> Vessel:
    """Read, segment, repair and trace."""
    with ledger.stage("segment") as tell:
        vessel = _vessel(path, settings)
        tell(" ".join(vessel.notes))
    with ledger.stage("trace") as tell:
        traced = trace(vessel, inlet_mm=_array(settings.inlet_mm))
        tell(f"{len(traced.outlets)} outlets; inlet {traced.inlet.diameter_mm:.1f} mm wide.")
    return traced


def _vessel(path: Path, settings: Settings) -> Vessel:
    if path.is_file() and is_surface_file(path):
        surface, notes = read_surface(path, units=settings.units)
        vessel = Vessel(surface, notes=notes)
    else:
        image = read_image(path, spacing_mm=settings.spacing_mm, shape=settings.shape)
        vessel = segment(image, threshold=settings.threshold, at_mm=_array(settings.at_mm))
    lumen, repairs = repair(vessel.lumen)
    return replace(vessel, lumen=lumen, notes=(*vessel.notes, *repairs))


def _deploy(design: Design, anatomy: Anatomy, settings: Settings) -> Deployment:
    landing = None if settings.center_mm is None else Landing(settings.center_mm)
    return deploy(design, anatomy, size=_size(design, anatomy, settings), landing=landing)


def _size(design: Design, anatomy: Anatomy, settings: Settings) -> Size:
    if settings.diameter_mm is None and settings.length_mm is None:
        return propose_size(design, anatomy)
    proposed = propose_size(design, anatomy)
    return find_size(
        design,
        diameter_mm=settings.diameter_mm or proposed.diameter_mm,
        length_mm=settings.length_mm or proposed.length_mm,
    )


def _flows(
    out: Path,
    anatomy: Anatomy,
    deployments: Mapping[str, Deployment],
    settings: Settings,
    ledger: _Ledger,
    anatomy_key: str,
) -> dict[str, FlowField]:
    """Compute the flow without and with each device; each is kept as soon as it is done."""
    if settings.flow is None:
        return {}
    fields: dict[str, FlowField] = {}
    for name in (BARE, *deployments):
        stent = deployments[name].stent if name in deployments else None
        placing = (name, settings.diameter_mm, settings.length_mm, settings.center_mm) if stent else BARE
        stage, key = f"flow {name}", _key(anatomy_key, settings.flow, placing)
        field = ledger.recall(stage, key, FlowField)
        if field is None:
            with ledger.stage(stage) as tell:
                case = flow_case(anatomy, stent, settings.flow)
                field = simulate_case(case, start=fields.get(BARE), progress=ledger.teller(stage))
                tell(field.advice)
            ledger.keep(stage, key, field)
        fields[name] = field
        _write_field(out / "flow" / name, field)
    return fields


def _metrics(
    anatomy: Anatomy, deployments: Mapping[str, Deployment], fields: Mapping[str, FlowField]
) -> dict[str, Any]:
    sac = anatomy.aneurysms[0] if anatomy.aneurysms else None
    shapes = (sac.sac, ostium(sac, anatomy.vessel.lumen)) if sac else ()
    flow = {name: indices(field, *shapes) for name, field in fields.items()}
    stents: dict[str, dict[str, Any]] = {}
    for name, deployment in deployments.items():
        stents[name] = {"deployment": measure(anatomy, deployment)}
        if name in flow:
            stents[name] |= {"flow": flow[name], "ratios": compare(flow[BARE], flow[name])}
    return {"vessel": morphology(anatomy), "stents": stents} | ({BARE: flow[BARE]} if flow else {})


def _write_vessel(out: Path, vessel: Vessel, *axes: Centerline) -> None:
    out.mkdir(parents=True, exist_ok=True)
    writers.write_surface(out / "vessel.vtp", vessel.lumen)
    writers.write_centerlines(out / "centerlines.vtp", (*vessel.centerlines, *axes))
    openings = [asdict(opening) | {"diameter_mm": opening.diameter_mm} for opening in vessel.openings]
    writers.write_json(out / "openings.json", {"openings": openings, "notes": vessel.notes})


def _write_anatomy(out: Path, anatomy: Anatomy) -> None:
    _write_vessel(out, anatomy.vessel, anatomy.axis)
    restored = {"is_restored": anatomy.is_restored.astype(np.uint8)}
    writers.write_surface(out / "landing_surface.vtp", anatomy.landing_surface, restored)
    if not anatomy.aneurysms:
        for stale in (out / "sac.vtp", out / "neck.vtp"):  # of another input or of other settings
            stale.unlink(missing_ok=True)
        return
    aneurysm = anatomy.aneurysms[0]
    writers.write_surface(out / "sac.vtp", aneurysm.sac)
    closed = np.concatenate([aneurysm.neck_mm, aneurysm.neck_mm[:1]])
    writers.write_lines(out / "neck.vtp", closed, np.array([0, len(closed)], dtype=np.int32))


def _write_stent(folder: Path, deployment: Deployment) -> str:
    stent = deployment.stent
    folder.mkdir(parents=True, exist_ok=True)
    writers.write_surface(folder / "contour.vtp", stent.contour, {"wall_gap_mm": deployment.wall_gap_mm.ravel()})
    wire_id = np.arange(len(stent.wire_diameter_um), dtype=np.int32)
    of_wire: dict[str, NDArray[Any]] = {"wire_id": wire_id, "diameter_um": stent.wire_diameter_um}
    writers.write_lines(folder / "wires.vtp", stent.wire_points_mm, stent.wire_starts, cell_data=of_wire)
    solid = struts(stent)
    writers.write_stl(folder / "struts.stl", solid)
    return f"{len(wire_id)} wires, {len(solid.faces)} triangles."


def _write_field(folder: Path, field: FlowField) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    of_cell = {"velocity_m_s": field.velocity_m_s, "pressure_Pa": field.pressure_Pa}
    writers.write_cells(folder / "field.vtu", field.centers_mm, field.cell_size_mm, of_cell)
    of_vertex = {"wall_shear_stress_Pa": field.wall_shear_stress_Pa, "pressure_Pa": field.wall_pressure_Pa}
    if field.phases:
        of_vertex |= {
            "time_averaged_wall_shear_stress_Pa": field.shear_Pa,
            "oscillatory_shear_index": field.oscillatory_shear_index,
            "relative_residence_time_per_Pa": field.relative_residence_time_per_Pa,
        }
    writers.write_surface(folder / "wall.vtp", field.wall, of_vertex)


def _provenance(path: Path, source: str, settings: Settings, ledger: _Ledger) -> dict[str, Any]:
    return {
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "input": {"name": "DICOM folder" if path.is_dir() else path.name, "sha256": source},
        "settings": asdict(settings),
        "seconds": ledger.seconds,
        "research_use_only": True,
    }


def _refuse_missing(path: Path) -> None:
    if not path.exists():
        raise ReadError(f"{path} does not exist: give a scan (DICOM folder, NIfTI, NRRD, MHA, raw) or a surface")


def _hash_of(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder in the order of their names."""
    _refuse_missing(path)
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            digest.update(file.name.encode() + b"\0")
            with file.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()


def _anatomy_key(source: str, settings: Settings) -> str:
    """Key of the geometry of an input: devices and flow do not change it."""
    return _key(source, replace(settings, devices=(), diameter_mm=None, length_mm=None, center_mm=None, flow=None))


def _key(*parts: Any) -> str:
    """Short name of everything that a result depends on, this version of the code included."""
    plain = [asdict(part) if is_dataclass(part) and not isinstance(part, type) else part for part in parts]
    return hashlib.sha256(json.dumps([version("vstent"), plain], sort_keys=True).encode()).hexdigest()[:16]


def _array(point_mm: Point | None) -> Floats | None:
    return None if point_mm is None else np.array(point_mm, dtype=np.float64)
