"""Export a case or an input for other solvers: an OpenFOAM case folder, or named patches."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vstent.devices.stent import Stent
from vstent.devices.treatment import Treatment
from vstent.errors import FlowError, InputError
from vstent.fields import differing
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.openfoam import program
from vstent.flow.openfoam.case import foam_case, strut_solids
from vstent.flow.openfoam.folder import write
from vstent.flow.openfoam.patches import named_patches, stl_text
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.problem import flow_case
from vstent.geometry.vessel import Anatomy
from vstent.io import writers
from vstent.study.folder import CACHE, refuse_older
from vstent.study.keys import hash_of, study_keys
from vstent.study.progress import OnProgress
from vstent.study.repeat import finished_run
from vstent.study.settings import AnatomySettings, InputSettings, Settings
from vstent.study.stages import check_inflow, deploy_all, find_anatomy, finished_anatomy
from vstent.study.store import Store


def export_openfoam(path: Path, out: Path, settings: Settings, foam: Mapping[str, Any], progress: OnProgress) -> None:
    """Write an OpenFOAM case folder of a case folder of `run`, or of a scan or surface.

    The wires of the first treatment, if any, are meshed. `foam` has fields of `FoamSetup`; the default flavor is
    that of the installed OpenFOAM. Where InputError is raised, nothing has been written.
    """
    store = Store(out / CACHE, progress)
    anatomy, stents = _deployed(path, settings, store, progress)
    check_inflow(anatomy, settings.flow)
    case = flow_case(anatomy, stents, settings.flow)
    setup = FoamSetup(default_cell_size_mm(case), processes=case.numerics.processes)
    try:
        installed = program.find().flavour
    except FlowError:
        installed = "com"
    setup = replace(setup, **{"flavour": installed, **foam}, struts=strut_solids(case))
    with store.stage("export") as tell:
        written = foam_case(case, setup)
        write(out, written)
        held = " The outlet flows are those without the device: see README." if stents and case.resistances else ""
        tell(f"{len(written.files)} files for {written.application}, grid spacing {setup.cell_size_mm:.3g} mm.{held}")


def export_patches(path: Path, out: Path, settings: Settings, progress: OnProgress) -> list[dict[str, Any]]:
    """Write the boundary of the lumen as watertight named patches; return name, id, area, center and normal of each.

    ``patches.stl`` has one named solid per patch, ``patches.vtp`` the same faces with their ``patch_id``, both in mm.
    ``patches.json`` describes the patches, and ``neck.stl`` is the surface through which blood enters the sac.
    """
    store = Store(out / CACHE, progress)
    case = flow_case(_deployed(path, replace(settings, treatments=()), store, progress)[0])
    with store.stage("export") as tell:
        patches, _ = named_patches(case)
        patch_id = np.zeros(len(patches[0].surface.faces), dtype=np.int32)
        said = []
        for k, patch in enumerate(patches):
            patch_id[patch.face_id] = k
            first, second, third = np.moveaxis(patch.corners_mm, 1, 0)
            area_mm2 = 0.5 * np.cross(second - first, third - first)
            total_mm2 = area_mm2.sum(axis=0)
            said.append(
                {
                    "name": patch.name,
                    "patch_id": k,
                    "area_mm2": patch.area_mm2,
                    "center_mm": np.average(
                        patch.corners_mm.mean(axis=1), axis=0, weights=np.linalg.norm(area_mm2, axis=1)
                    ),
                    "normal": total_mm2 / max(float(np.linalg.norm(total_mm2)), 1e-12),
                }
            )
        writers.write_text(out / "patches.stl", stl_text({one.name: one.corners_mm for one in patches}, 1.0))
        writers.write_surface(out / "patches.vtp", patches[0].surface, cell_data={"patch_id": patch_id})
        if case.ostium is not None:
            writers.write_stl(out / "neck.stl", case.ostium)
        writers.write_json(out / "patches.json", {"length_unit": "mm", "frame": "LPS", "patches": said})
        tell(f"{len(patches)} patches, {len(patch_id)} triangles.")
    return said


def _of_run(wanted: Treatment, treatments: Sequence[Treatment]) -> Treatment:
    """Return the treatment of a run that is meant by its name alone or by its devices; else the wanted one."""
    for one in treatments:
        is_named = wanted.devices == (wanted.name,) and one.name.casefold() == wanted.name
        if wanted.is_proposed and (is_named or (one.name, one.plan) == (wanted.name, wanted.plan)):
            return one
    return wanted


def _deployed(path: Path, settings: Settings, store: Store, progress: OnProgress) -> tuple[Anatomy, list[Stent]]:
    """Return the anatomy of the run of a case folder, or of an input, and the implants of the first treatment.

    They are as given, else as in the case folder's own run, else as proposed.
    """
    refuse_older(path, "Run its study again into another folder, and export that.")
    study = replace(settings, treatments=settings.treatments[:1], flow=None, uncertainty=None)
    if (path / CACHE).is_dir():
        given = [*differing(InputSettings(), settings.input), *differing(AnatomySettings(), settings.anatomy)]
        if given:
            words = ", ".join(f"--{name}" for name in given)
            raise InputError(f"{path} is a case folder, whose vessel is exported as it is: leave out {words}")
        source, of_run = finished_run(path)
        chosen = [_of_run(one, of_run.treatments) for one in study.treatments]
        study = replace(study, input=of_run.input, anatomy=of_run.anatomy, treatments=tuple(chosen))
        store, keys = Store(path / CACHE, progress), study_keys(source, study)
        anatomy = finished_anatomy(path, store, keys)
    else:
        keys = study_keys(hash_of(path), study)
        anatomy = find_anatomy(path, study, store, keys)
    if not study.treatments:
        return anatomy, []
    (implants,) = deploy_all(anatomy, study, store, keys)[0].values()
    return anatomy, [implant.stent for implant in implants.values()]
