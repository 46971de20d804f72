"""Rank by flow: the best sizes by geometry get a flow, and its reductions and its retention join the ranking."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final, Protocol, TypeVar

from vstent.anatomy.morphology import Measures
from vstent.angiography.angiogram import PREVIEW_ERROR, AngiogramSettings, angiogram
from vstent.angiography.curves import retention_s
from vstent.deployment.deploy import deploy, propose_landing
from vstent.devices.stent import Landing, Stent
from vstent.errors import FlowError, InputError
from vstent.flow.background import BackgroundWork
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.grade import NOT_USABLE, grade
from vstent.flow.indices import indices
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy
from vstent.plan.criteria import Criteria
from vstent.plan.rank import Candidate, Ranking, graded_anew, ordered

Value = TypeVar("Value")

REDUCED: Final = {
    "neck_inflow_mL_s": "neck_inflow_change_fraction",
    "mean_sac_velocity_m_s": "sac_velocity_change_fraction",
    "mean_sac_wss_Pa": "sac_wss_change_fraction",
}
"""Index of a flow, and the measure of its change against the flow without a device."""
RETENTION: Final = "contrast_retention_change_fraction"
"""Measure of the change of the retention of contrast in the sac against the flow without a device."""
CONTRAST: Final = AngiogramSettings(window_s=10.0, is_preview=True)
"""Angiogram that measures the retention: with the default injection, on a grid twice as coarse."""
COVERAGE: Final = "neck_metal_coverage_fraction"
"""Measure by which similar devices are found."""
SIMILAR: Final = 0.1
"""Largest relative difference of the coverage of the neck by devices that count as similar. Beyond it the start
matters: a flow with Enterprise that starts from one with Pipeline ends 1 to 4 % from the one that starts without a
device (demo, grid spacing 0.3 mm)."""


class Stored(Protocol):
    """Results of finished flows by candidate, None for the flow without a device; a dict will do."""

    def get(self, candidate: Candidate | None, /) -> Mapping[str, Any] | None:
        """Return a result, or None if that flow is not finished."""

    def __setitem__(self, candidate: Candidate | None, result: Mapping[str, Any], /) -> None:
        """Keep a result."""


def rank_flows(
    anatomy: Anatomy,
    ranking: Ranking,
    settings: FlowSettings,
    count: int,
    *,
    has_contrast: bool = False,
    stored: Stored | None = None,
    keep: Callable[[Candidate | None, FlowField], None] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> Ranking:
    """Compute the flow with the best candidates of a ranking, the best of every device among them.

    Every flow starts from the nearest one computed in the same call: the one whose device covers the neck by the most
    similar fraction with metal, or without a device where none is `SIMILAR`. The start changes a result within its
    uncertainty only. An interrupted ranking, whose flows start from others, gives the same numbers within that.

    Of the candidates, in the same order, those with a flow have its changes, its uncertainty and its grade among their
    measures, and a sentence on it among their reasons. With contrast, those with a retention have new scores and are
    ordered among the places that they have.

    Parameters
    ----------
    count : number of candidates that get a flow.
    has_contrast : whether contrast is carried through the flows, and its retention in the sac counts in the scores.
    stored : finished results by candidate; those that are there are not computed again, and new ones are added.
    keep : called with every flow that a study would compute in the same way: without a device, or started from that.
    progress : called with the number of finished flows, the number of all, and the name of the next.

    Raises
    ------
    InputError
        There is no sac, or no candidate is suitable.
    FlowError
        The flow without a device cannot be computed.
    """
    if not anatomy.aneurysms:
        raise InputError("A ranking by flow needs a sac, and none was found. Rank without --flow.")
    chosen = chosen_of(ranking, count)
    if not chosen:
        raise InputError("No size is suitable, so there is no flow to compute. Choose another device.")
    found: Stored = {} if stored is None else stored
    unfinished = [one for one in chosen if not is_finished(found.get(one), has_contrast)]
    flows = _Flows(anatomy, settings, has_contrast, [coverage_of(one) for one in unfinished], keep)
    waiting: dict[Candidate | None, Callable[[], Mapping[str, Any]]] = {}
    criteria = ranking.criteria if has_contrast else None
    with BackgroundWork(settings.numerics) as background:
        for done, candidate in enumerate([None, *chosen]):
            if progress is not None:
                progress(done, 1 + len(chosen), "no device" if candidate is None else candidate.label)
            result = found.get(candidate)
            if result is None or candidate in unfinished or (candidate is None and unfinished):
                waiting[candidate] = background.begin(partial(_stored, found, candidate, flows.computed(candidate)))
            else:
                waiting[candidate] = partial(dict, result)
    results = {candidate: wait() for candidate, wait in waiting.items()}
    told = [
        _with_flow(one, results[None], results[one], criteria) if one in results else one for one in ranking.candidates
    ]
    # Candidates with a retention are ordered among the places that they have.
    places = [place for place, one in enumerate(told) if RETENTION in one.measures]
    for place, one in zip(places, ordered(told[place] for place in places), strict=True):
        told[place] = one
    return replace(ranking, candidates=tuple(told))


def _stored(found: Stored, candidate: Candidate | None, measured: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the result of a flow, measured and stored."""
    found[candidate] = result = measured()
    return result


def is_finished(result: Mapping[str, Any] | None, has_contrast: bool) -> bool:
    """Return whether a result holds what is asked for."""
    return result is not None and ("error" in result or not has_contrast or "contrast" in result)


def chosen_of(ranking: Ranking, count: int) -> list[Candidate]:
    """Return the best suitable candidate of every device, and others in their order, `count` in all if that is more."""
    best: dict[str, Candidate] = {}
    for candidate in ranking.suitable:
        best.setdefault(candidate.design.key, candidate)
    others = [one for one in ranking.suitable if one is not best[one.design.key]]
    return [*best.values(), *others[: max(0, count - len(best))]]


class _Flows:
    """Flows in one vessel, each started from the nearest one. Flows from which none of the others starts are dropped.

    The devices, in the order in which they are computed, cover the neck by the fractions `coming`.
    """

    def __init__(
        self,
        anatomy: Anatomy,
        settings: FlowSettings,
        has_contrast: bool,
        coming: list[float],
        keep: Callable[[Candidate | None, FlowField], None] | None = None,
    ) -> None:
        self.anatomy, self.settings, self.has_contrast = anatomy, settings, has_contrast
        self._coming, self._keep = coming, keep
        self._bare: FlowField | None = None
        self._done: list[tuple[float, FlowField]] = []

    def computed(self, candidate: Candidate | None) -> Callable[[], Mapping[str, Any]]:
        """Compute the flow with a candidate, or without a device, and return a function that measures it."""
        if candidate is not None:
            self._coming = self._coming[1:]
        covered = coverage_of(candidate)
        similar = nearest(covered, self._done)
        field, measured = flow_with(
            self.anatomy, candidate, self.settings, start=self._bare, similar=similar, has_contrast=self.has_contrast
        )
        is_as_asked = candidate is None or self.settings == with_screens(self.settings)
        if self._keep is not None and field is not None and similar is None and is_as_asked:
            self._keep(candidate, field)
        if candidate is None:
            self._bare = field
        elif field is not None:
            self._done.append((covered, field))
            self._done = [one for one in self._done if any(is_similar(one[0], other) for other in self._coming)]
        return measured


def flow_with(
    anatomy: Anatomy,
    candidate: Candidate | None,
    settings: FlowSettings,
    *,
    start: FlowField | None,
    similar: FlowField | None,
    has_contrast: bool,
) -> tuple[FlowField | None, Callable[[], Mapping[str, Any]]]:
    """Compute the flow with one candidate, and return it with a function that measures what a ranking keeps of it.

    Wires are as in `with_screens`. The flow starts from that with a `similar` device, or from that without one,
    `start`. Where the flow with a device cannot be computed, it is None, and the function returns an error message;
    without a device a FlowError is raised.
    """
    stents = () if candidate is None else (stent_of(anatomy, candidate),)
    case = flow_case(anatomy, stents, with_screens(settings))
    try:
        field = simulate_case(case, start=start, similar=similar)
    except FlowError as error:
        if candidate is None:
            raise
        return None, partial(dict, {"error": str(error)})
    return field, partial(_measured, anatomy if has_contrast else None, case, field)


def with_screens(settings: FlowSettings) -> FlowSettings:
    """Return settings with wires as a screen, calibrated where that is asked for."""
    numerics = settings.numerics
    return replace(
        settings, numerics=replace(numerics, wires="calibrated" if numerics.wires == "calibrated" else "screen")
    )


def _measured(carrying: Anatomy | None, case: FlowCase, field: FlowField) -> Mapping[str, Any]:
    """Return what a ranking keeps of a flow, with the retention of contrast where an anatomy is given."""
    values = indices(field, case.sac, case.ostium)
    kept: dict[str, Any] = {key: values[key] for key in REDUCED} | {"unsettled_fraction": field.unsettled_fraction}
    kept["grade"] = grade(case, field, values).level
    if carrying is not None:
        kept["contrast"] = _contrast(carrying, field)
    return kept


def nearest(coverage: float, done: Iterable[tuple[float, Value]]) -> Value | None:
    """Return what belongs to the most similar coverage of the neck in `done`; None if none is similar."""
    covered, found = min(done, key=lambda one: abs(one[0] - coverage), default=(0.0, None))
    return found if is_similar(covered, coverage) else None


def is_similar(coverage: float, other: float) -> bool:
    """Return whether a flow with this coverage is a start for that with another one."""
    return abs(coverage - other) < SIMILAR * other


def coverage_of(candidate: Candidate | None) -> float:
    """Return the metal coverage of the neck, 0 without a device or where the device misses the neck."""
    found = 0.0 if candidate is None else float(candidate.measures.get(COVERAGE) or 0.0)
    return found if found == found else 0.0


def _contrast(anatomy: Anatomy, field: FlowField) -> dict[str, Any]:
    """Return the retention of contrast in a flow, and whether it is only the least that it can be; or an error."""
    try:
        found = retention_s(angiogram(anatomy, field, CONTRAST).curves)
    except (FlowError, InputError) as error:
        return {"error": str(error)}
    if found is None:
        return {"error": f"the parent artery keeps contrast for more than {CONTRAST.window_s:g} s"}
    return {"retention_s": found[0], "is_least": found[1]}


def stent_of(anatomy: Anatomy, candidate: Candidate) -> Stent:
    """Return the deployed device of a candidate."""
    design, size, shift_mm = candidate.design, candidate.size, candidate.shift_mm
    landing = Landing(propose_landing(design, anatomy, size).abscissa_mm + shift_mm) if shift_mm else None
    return deploy(design, anatomy, size=size, landing=landing).stent


def _with_flow(
    candidate: Candidate, bare: Mapping[str, Any], flow: Mapping[str, Any], criteria: Criteria | None
) -> Candidate:
    """Return a candidate with the changes of its flow among its measures and reasons.

    With criteria the retention of contrast counts in its score.
    """
    if "error" in flow:
        return replace(candidate, reason=f"{candidate.reason} Flow not computed: {flow['error']}")
    found: Measures = {"flow_grade": flow["grade"], "flow_uncertainty_fraction": flow["unsettled_fraction"]}
    if NOT_USABLE in (flow["grade"], bare["grade"]):
        return replace(candidate, measures=candidate.measures | found, reason=f"{candidate.reason} Flow: {NOT_USABLE}.")
    found |= {name: flow[key] / bare[key] - 1 for key, name in REDUCED.items() if bare[key]}
    inflow, velocity = (float(found[REDUCED[key]]) for key in ("neck_inflow_mL_s", "mean_sac_velocity_m_s"))
    words = f"Flow ({flow['grade']}): neck inflow {inflow:+.0%}, sac velocity {velocity:+.0%}."
    if criteria is not None:
        change, said = _retained(bare["contrast"], flow["contrast"])
        words = f"{words} {said}"
        if change is not None:
            candidate = graded_anew(replace(candidate, measures=candidate.measures | {RETENTION: change}), criteria)
    return replace(candidate, measures=candidate.measures | found, reason=f"{candidate.reason} {words}")


def _retained(bare: Mapping[str, Any], flow: Mapping[str, Any]) -> tuple[float | None, str]:
    """Return the change of the retention of contrast and a sentence on it; None where it is not known."""
    for one in (bare, flow):
        if "error" in one:
            return None, f"Contrast: {one['error']}."
    if bare["is_least"] or bare["retention_s"] <= 0:
        return None, "Contrast: its retention without a device is not known."
    change = flow["retention_s"] / bare["retention_s"] - 1
    least = "at least " if flow["is_least"] else ""
    words = f"{least}{flow['retention_s']:.2f} s, without a device {bare['retention_s']:.2f} s"
    return change, f"Contrast stays {words} (preview, error up to {PREVIEW_ERROR:.0%} on the demo)."
