"""Deploy and rank all sizes of the chosen devices, with the flow of the best, and store the ranking for the page."""

import os
from typing import Any, Final

from vstent.app.cases import Case
from vstent.app.jobs import RANKING
from vstent.devices.catalogue import find_design
from vstent.devices.treatment import BARE, Placing, Treatment
from vstent.flow.case import FlowField
from vstent.flow.settings import FlowSettings
from vstent.io.writers import write_json
from vstent.plan.rank import Candidate, Ranking, rank
from vstent.plan.rank_flow import rank_flows
from vstent.reporting.definitions import DEFINITIONS
from vstent.study.folder import CACHE
from vstent.study.keys import ANATOMY, study_keys
from vstent.study.progress import OnProgress, Progress
from vstent.study.ranking_flows import FlowStore
from vstent.study.stages import ask_for_aneurysm, find_anatomy
from vstent.study.store import Key, Store

MOST_PROCESSES: Final = 4
"""Largest number of parallel processes."""
WORTH_A_PROCESS: Final = 12
"""Number of sizes whose deployment takes longer than starting another process."""

COLUMNS: Final = {
    "deployed_length_mm": ("Length", ""),
    "landing_length_mm": ("Landing", "Shorter of the two lengths of device beyond the ends of the neck."),
    "neck_metal_coverage_fraction": ("Coverage", ""),
    "apposed_fraction": ("Apposed", ""),
    "max_wall_gap_mm": ("Largest gap", ""),
    "jailed_branches_count": ("Branches", ""),
    "neck_inflow_change_fraction": ("Neck inflow", "Change of the neck inflow against the flow without a device."),
    "sac_velocity_change_fraction": ("Sac velocity", "Change of the mean sac velocity against no device."),
    "sac_wss_change_fraction": ("Sac shear", "Change of the mean wall shear stress on the sac against no device."),
    "flow_uncertainty_fraction": ("still moving by", "Part by which the flow would still change; not its error."),
    "flow_grade": ("Grade", "Grade of the flow: good, fair or not usable."),
}
"""Heading and meaning of every column of measures; an empty meaning is that of `DEFINITIONS`."""


def rank_sizes(case: Case, progress: OnProgress) -> None:
    """Rank every size of the chosen devices and store the ranking in the case folder.

    The ranking by geometry is stored before the first flow. Finished flows are kept, so that a stopped ranking goes on.

    Raises InputError: no device is chosen, or flows are wanted and there is no sac or no suitable size.
    Raises FlowError: the flow without a device cannot be computed.
    """
    settings, store = case.state.settings(), Store(case.folder / CACHE, progress)
    keys = study_keys(case.state.source, settings)
    anatomy = find_anatomy(case.input, settings, store, keys)
    ask_for_aneurysm(anatomy, settings)

    def told(n_done: int, n_all: int) -> None:
        progress(Progress("rank", min(n_done / n_all, 0.99), f"{n_done} of {n_all} sizes"))

    progress(Progress("rank", 0.0))
    designs = [find_design(name) for name in case.state.choices.ranked]
    n_sizes = sum(len(design.sizes) for design in designs)
    jobs = min(os.cpu_count() or 1, MOST_PROCESSES, 1 + n_sizes // WORTH_A_PROCESS)
    found = rank(anatomy, designs, jobs=jobs, progress=told)
    key, n_flows = keys[ANATOMY], case.state.choices.ranking_flows
    _write(case, key, found)
    progress(Progress("rank", 1.0, f"{len(found.suitable)} of {len(found.candidates)} sizes are suitable."))
    if n_flows:
        progress(Progress("rank_flow", 0.0))
        flow = settings.flow or FlowSettings()

        def told_flow(n_done: float, n_all: int, name: str) -> None:
            progress(Progress("rank_flow", min(n_done / n_all, 0.99), f"{n_done} of {n_all}: {name}"))

        def keep(candidate: Candidate | None, field: FlowField) -> None:
            """Store a flow of the chosen treatments as that of the study, so that the step Flow finds it."""
            names = [BARE] if candidate is None else [one.name for one in settings.treatments if _is_of(one, candidate)]
            for stage in (f"flow {name}" for name in names if f"flow {name}" in keys):
                store.save(stage, keys[stage], field)

        stored = FlowStore(case.folder, key, flow)
        _write(case, key, rank_flows(anatomy, found, flow, n_flows, stored=stored, keep=keep, progress=told_flow))
        progress(Progress("rank_flow", 1.0))


def _is_of(treatment: Treatment, candidate: Candidate) -> bool:
    """Return whether a candidate is what a treatment deploys: its only device, in this size at the proposed place."""
    implant = treatment.implants[0]
    given = implant.diameter_mm, implant.length_mm
    is_size = given == (candidate.size.diameter_mm, candidate.size.length_mm) or (
        given == (None, None) and candidate.is_proposed
    )
    is_alone = len(treatment.implants) == 1 and treatment.has_flow and implant.placing == Placing()
    return is_alone and is_size and implant.device == candidate.design.key and candidate.shift_mm == 0


def _write(case: Case, anatomy: Key, found: Ranking) -> None:
    """Store a ranking with the names of its devices and its columns."""
    rows = found.rows()
    content: dict[str, Any] = {
        "anatomy": str(anatomy),
        "devices": sorted({candidate.design.key for candidate in found.candidates}),
        "names": {candidate.design.key: candidate.design.name for candidate in found.candidates},
        "columns": [
            {"key": key, "title": title, "meaning": meaning or DEFINITIONS[key].meaning}
            for key, (title, meaning) in COLUMNS.items()
            if any(key in row for row in rows)
        ],
        "rows": rows,
    }
    write_json(case.folder / RANKING, content)
