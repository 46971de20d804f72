"""Terminal output: a line for every stage with its time, and the tables of results."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import degrees
from statistics import median
from typing import Any, Final

from rich.console import Console as RichConsole
from rich.status import Status
from rich.table import Column, Table

from vstent.deployment.coverage import UNION
from vstent.devices.design import Design
from vstent.devices.fit import Fitted
from vstent.devices.ranges import MARGIN
from vstent.devices.treatment import BARE
from vstent.flow.convergence import POSITIONS, Refinement, Scatter
from vstent.flow.grade import unusable
from vstent.geometry.vessel import Opening
from vstent.plan.rank import Candidate, Ranking
from vstent.reporting.definitions import INDICES_WITH_OCCLUSION
from vstent.reporting.quality import qualities
from vstent.reporting.quantities import ERRORS, flatten, format_change, format_value, opening_rows, spoken
from vstent.reporting.ranked import treatment_rows
from vstent.reporting.uncertainty import ends, how_sure, intervals, number_name
from vstent.study.followup import Followup
from vstent.study.progress import Progress
from vstent.units import counted, duration

ROWS: Final = (
    ("Neck inflow", "neck_inflow_mL_s"),
    ("- 0.5 mm into the sac", "neck_inflow_in_sac_mL_s"),
    ("- 0.5 mm into the artery", "neck_inflow_in_artery_mL_s"),
    ("Mean sac velocity", "mean_sac_velocity_m_s"),
    ("Sac wall shear stress, mean", "mean_sac_wss_Pa"),
    ("Turnover time", "turnover_time_s"),
)
"""Rows of the comparison of flows: title and key of the index."""
CONTRAST_ROWS: Final = (
    *("contrast_preview_error_fraction", "contrast_arrival_s", "contrast_peak_s", "contrast_peak_fraction"),
    *("washout_half_life_s", "contrast_retention_s", "contrast_mean_transit_s", "mean_sac_age_s", "turnover_time_s"),
    *(f"unexchanged_after_{moment}s_volume_mm3" for moment in (1, 2, 5)),
    *("unexchanged_after_5s_area_mm2", "fast_sac_volume_mm3", "mean_sac_velocity_m_s"),
)
"""Keys of the table of angiograms."""
DEVICE_ROWS: Final = (
    ("Size (label)", "size"),
    ("Deployed length", "deployed_length_mm"),
    ("Apposed", "apposed_fraction"),
    ("Metal coverage over the neck", "neck_metal_coverage_fraction"),
    ("Basket, height", "basket_height_mm"),
    ("Stands out into the artery", "protrusion_mm"),
    ("Basket, neck left open", "neck_uncovered_fraction"),
    ("Coils, packing density", "packing_density_fraction"),
    ("Coils, length of all", "coil_length_mm"),
    ("Coils, neck covered", "neck_covered_by_coils_fraction"),
)
"""Rows of the comparison of deployments: title and key of the measure."""


QUIET_S: Final = 30.0
"""Time between progress lines where the output is not a terminal, in s."""


class Console:
    """Prints the progress of a study to standard error and its tables to standard output."""

    def __init__(self) -> None:
        self._err = RichConsole(stderr=True, highlight=False)
        self._out = RichConsole(highlight=False)
        self._status: Status | None = None
        self._began: dict[str, float] = {}
        self._told = time.monotonic()
        self.printed = ""
        """Everything printed on standard output."""

    @contextmanager
    def live(self) -> Iterator[None]:
        """Show a spinner with the current stage on a terminal."""
        with self._err.status("starting") as self._status:
            yield
        self._status = None

    def progress(self, told: Progress) -> None:
        """Show the progress of a stage: on a terminal in the spinner, else a line every `QUIET_S`."""
        now, stage = time.monotonic(), told.stage
        began = self._began.setdefault(stage, now)
        if told.fraction >= 1.0:
            self._err.print(f"[bold]{stage:18}[/] {now - began:6.1f} s  [dim]{told.detail}[/]", soft_wrap=True)
            del self._began[stage]
        elif self._err.is_terminal and self._status is not None:
            self._status.update(f"{stage} {told.fraction:4.0%} {_state(told)}")
        elif now - self._told > QUIET_S and told.fraction > 0:
            self._told = now
            self._err.print(f"{stage:18} {told.fraction:4.0%} {_state(told)}", soft_wrap=True)

    def say(self, text: str) -> None:
        """Print a line on standard error."""
        self._err.print(text, soft_wrap=True, markup=False)

    def print(self, item: Any) -> None:
        """Print a line or a table on standard output."""
        self._out.print(item)
        with self._out.capture() as again:
            self._out.print(item)
        self.printed += again.get()


def _state(told: Progress) -> str:
    """Return what an unfinished stage does, how far a flow is from convergence, and the remaining time."""
    parts = [told.detail]
    if told.residual is not None:
        parts.append(f"{told.residual:.1%} from convergence")
    if told.seconds_left is not None:
        parts.append(f"about {duration(told.seconds_left)} left")
    return ", ".join(part for part in parts if part)


def comparison_table(metrics: Mapping[str, Any]) -> Table:
    """Return the table of the main results: in the bare artery, and with each treatment and its relative change."""
    treatments, bare = _treatments(metrics), _bare(metrics)
    table = _table("", "no device", *treatments)
    for title, key in DEVICE_ROWS:
        cells = [
            " + ".join(
                f"{_cell(key, implant.get(key))} {_spaced(ends(implant, key))}".rstrip()
                for implant in treatment["implants"].values()
                if key in implant
            )
            for treatment in treatments.values()
        ]
        if any(cells):
            table.add_row(title, "", *cells)
    unions = [treatment.get("together", {}).get(UNION) for treatment in treatments.values()]
    if any(len(treatment["implants"]) > 1 for treatment in treatments.values()) and any(unions):
        table.add_row("Metal on the neck, all devices", "", *(_cell(UNION, union) for union in unions))
    if bare:
        table.add_section()
        _add_flow_rows(table, metrics, {key: title for title, key in ROWS})
    return table


def _table(title: str, *treatments: str) -> Table:
    """Return an empty table with a column for every treatment; however narrow it is, no name is cut."""
    return Table(title, *(Column(name, overflow="fold") for name in treatments))


def _treatments(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metrics of all treatments with implants, by name."""
    return {name: treatment for name, treatment in metrics["treatments"].items() if name != BARE}


def _bare(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metrics of the flow in the bare artery; empty without flows."""
    return dict(metrics["treatments"].get(BARE, {}).get("flow", {}))


def device_sentences(metrics: Mapping[str, Any]) -> list[str]:
    """Return how sure each device is, one text each; the ranges are those of its first implant."""
    first: dict[str, tuple[Any, str]] = {}
    for name, treatment in _treatments(metrics).items():
        for key, implant in treatment["implants"].items():
            if implant.get("bands"):
                title = name if key == name else f"{key} of {name}"
                first.setdefault(implant["bands"]["device"], (implant, title))
    return [_spaced(how_sure(*one)) for one in first.values()]


def _add_flow_rows(table: Table, metrics: Mapping[str, Any], titles: Mapping[str, str]) -> None:
    """Add the grades of the flows and the indices with these keys and titles, each with its change where it is usable.

    The reasons of the grades and the grid are the caption.
    """
    treatments, bare = _treatments(metrics), _bare(metrics)
    graded = {one.name: one for one in qualities(metrics, {name: name for name in treatments})}
    if graded:
        table.add_row(
            "Grid and convergence", *(graded[name].grade if name in graded else "" for name in (BARE, *treatments))
        )
        reasons = (one.sentence for one in graded.values() if one.reasons)
        table.caption = "\n".join([f"Flow: {graded[BARE].computation}.", *reasons])
        table.caption_justify = "left"
    hidden = unusable(metrics)
    for key, title in titles.items():
        if key in bare:
            values = {name: treatment.get("flow", {}).get(key) for name, treatment in treatments.items()}
            shown = (_cell(key, x) if name in hidden else _change(key, bare[key], x) for name, x in values.items())
            table.add_row(title, _cell(key, bare[key]), *shown)


COHORT_ROWS: Final = (
    ("length, mm", "implant.deployed_length_mm", "{:.1f}"),
    ("apposed", "implant.apposed_fraction", "{:.0%}"),
    ("metal at neck", "implant.neck_metal_coverage_fraction", "{:.0%}"),
    ("neck inflow, after / before", "change.neck_inflow_mL_s_ratio", "{:.2f}"),
    ("s a case", "case_s", "{:.1f}"),
    ("CPU s a case", "case_cpu_s", "{:.1f}"),
    ("MB", "peak_memory_MB", "{:.0f}"),
)
"""Rows of the cohort table: title, key and number format."""
RANKING_COLUMNS: Final = (
    ("mm long", "deployed_length_mm", "{:.1f}"),
    ("apposed", "apposed_fraction", "{:.0%}"),
    ("mm beyond neck", "landing_length_mm", "{:.1f}"),
    ("metal at neck", "neck_metal_coverage_fraction", "{:.0%}"),
)
"""Columns of the ranking: title, key of the measure and number format."""
FLOW_COLUMNS: Final = (
    ("neck inflow", "neck_inflow_change_fraction", "{:+.0%}"),
    ("sac velocity", "sac_velocity_change_fraction", "{:+.0%}"),
    ("retention", "contrast_retention_change_fraction", "{:+.0%}"),
    ("±", "flow_uncertainty_fraction", "{:.1%}"),
    ("flow", "flow_grade", "{}"),
)
"""Columns of a ranking by flow: title, key of the measure and number format."""


def ranking_tables(ranking: Ranking, shown: int) -> list[Table]:
    """Return the table of the best candidates of a ranking, and one of their flows where there are any."""
    tables: list[Table] = []
    for all_columns in (RANKING_COLUMNS, FLOW_COLUMNS):
        rows = [one for one in _shown(ranking, shown) if one[1].measures.get(all_columns[0][1]) is not None]
        columns = [one for one in all_columns if any(one[1] in candidate.measures for _, candidate in rows)]
        table = Table("", "device and size, mm", *["score"] * (not tables), *(title for title, _, _ in columns))
        for number, candidate in rows:
            measures = candidate.measures
            cells = ["" if measures.get(key) is None else _typed(form, measures[key]) for _, key, form in columns]
            if "deployed_length_low_mm" in measures and all_columns is RANKING_COLUMNS:
                cells[0] += f" ({measures['deployed_length_low_mm']:.1f}-{measures['deployed_length_high_mm']:.1f})"
            label = candidate.label.removesuffix(" mm") + f" @{candidate.shift_mm:+g}" * bool(candidate.shift_mm)
            if not tables:
                cells.insert(0, f"{100 * candidate.score:.0f}" if candidate.is_suitable else "out")
            table.add_row(str(number), f"{label}{' *' if candidate.is_proposed else ''}", *cells)
        for column in table.columns:  # a title a word a line, so that 80 columns are enough
            column.max_width = max(6, *(len(word) for word in f"{column.header} x".split()))
            column.overflow = "fold"
        table.columns[1].max_width = None
        if not tables:
            table.columns[3].max_width = len("(18.1-24.3)")
        tables += [table] if rows else []
    tables[0].caption = (
        f"{len(ranking.candidates)} tried, {len(ranking.suitable)} suitable; scores of 100. * is the size that vstent "
        "run proposes, @ a shift in mm. In brackets: 95 % band from the ranges of the device's numbers."
    )
    return tables


def treatments_table(ranked: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of ranked treatments."""
    head, rows = treatment_rows(ranked)
    (_, *names), *measures = list(zip(head, *rows, strict=True))[1:]
    table = _table("treatment", *names)
    for cells in measures:
        table.add_row(*map(_spaced, cells))
    table.caption = "The best first; scores of 100. With jailed branches: the change of their flow."
    return table


def treatment_reasons(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one line per treatment with the reasons for its rank."""
    return "\n".join(f"{n}. {row['treatment']}: {_typed('{}', row['reason'])}" for n, row in enumerate(rows, start=1))


def ranking_reasons(ranking: Ranking, shown: int) -> str:
    """Return one line per candidate with the reasons for its rank."""
    return "\n".join(f"{n}. {one.label}: {_typed('{}', one.reason)}" for n, one in _shown(ranking, shown))


def _shown(ranking: Ranking, count: int) -> list[tuple[int, Candidate]]:
    """Return the best candidates and the best one of every other device, each with its rank."""
    numbered = list(enumerate(ranking.candidates, start=1))
    best: dict[str, tuple[int, Candidate]] = {}
    for number, candidate in numbered:
        best.setdefault(candidate.design.key, (number, candidate))
    return numbered[:count] + [one for one in best.values() if one[0] > count]


def cohort_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of a cohort: one column per treatment with medians over the finished cases."""
    names = dict.fromkeys(row["treatment"] for row in rows)
    own = [[row for row in rows if row["treatment"] == name] for name in names]
    table = _table("treatment", *names)
    for outcome in ("done", "failed", "lost"):
        table.add_row(outcome, *(str(sum(row["outcome"] == outcome for row in some)) for some in own))
    for title, key, form in COHORT_ROWS:
        found = [[row[key] for row in some if row.get(key) is not None] for some in own]
        if any(found):
            table.add_row(title, *(_typed(form, median(values)) if values else "" for values in found))
    table.caption = "Medians of the finished cases."
    return table


def uncertainty_table(metrics: Mapping[str, Any]) -> Table:
    """Return the table of uncertainty intervals of all results, with the main causes."""
    table = Table("treatment", "result", "mean", "95 % interval from", "to", "main causes", title="uncertainty")
    for name, found in _treatments(metrics).items():
        for row in intervals(found):
            causes = ", ".join(f"{cause} {share:.0%}" for cause, share in row.shares if share >= 0.005)
            table.add_row(name, row.name, row.mean, row.low, row.high, causes)
    return table


def opening_table(openings: Sequence[Opening]) -> Table:
    """Return the table of openings: role, diameter, area, center."""
    table = Table("opening", "diameter", "area", "center (LPS)")
    for row in opening_rows(openings):
        table.add_row(*map(_spaced, row))
    return table


def morphology_table(measures: Mapping[str, Any]) -> Table:
    """Return the table of morphology: name and value with unit."""
    table = Table("morphology", "")
    for quantity in flatten(measures):
        table.add_row(quantity.name, quantity.text)
    return table


def flow_table(metrics: Mapping[str, Any]) -> Table:
    """Return the table of all flow indices: bare, and with each treatment and its relative change."""
    table = _table("flow", "no device", *_treatments(metrics))
    _add_flow_rows(table, metrics, {quantity.key: quantity.name for quantity in flatten(_bare(metrics))})
    return table


def angiogram_table(metrics: Mapping[str, Any]) -> Table:
    """Return the table of angiograms: bare, and with each treatment and its relative change."""
    table = _table("angiogram", "no device", *_treatments(metrics))
    _add_flow_rows(table, metrics, {key: _title(key) for key in CONTRAST_ROWS})
    table.caption = "\n".join([str(table.caption or ""), *INDICES_WITH_OCCLUSION]).strip()
    return table


def followup_table(found: Followup) -> Table:
    """Return the table of what was planned and what is there after the treatment."""
    table = Table("", "planned", "after treatment")
    for key, planned in found.planned.items():
        table.add_row(_title(key), _cell(key, planned), _cell(key, found.real[key]))
    return table


def convergence_table(found: Refinement) -> Table:
    """Return the table of one refinement: every quantity at three sizes, observed order and extrapolated value."""
    columns = (f"{size:.3g}" for size in found.sizes)
    table = Table(found.name.replace("_", " "), *columns, "order", "limit", "±")
    for key, one in found.quantities.items():
        order = "not monotone" if one.order is None else f"{one.order:.1f}"
        *values, limit = (_cell(key, value) for value in (*one.values, one.extrapolated))
        table.add_row(_title(key), *values, order, limit, f"{one.uncertainty_fraction:.1%}")
    return table


def positions_table(found: Mapping[str, Scatter]) -> Table:
    """Return the table of one flow in several orientations on the grid: every quantity, its mean and half its range."""
    table = Table("orientation on the grid", *POSITIONS, "mean", "±")
    for key, one in found.items():
        values = (_cell(key, value) for value in (*one.values, one.mean))
        table.add_row(_title(key), *values, f"{one.uncertainty_fraction:.1%}")
    return table


def _title(key: str) -> str:
    """Return the name of a quantity."""
    return flatten({key: 0.0})[0].name


def _cell(key: str, value: Any) -> str:
    """Return a value with its unit; empty where there is none."""
    return "" if value is None else _spaced(format_value(key, value))


def _typed(form: str, value: Any) -> str:
    """Return a value in a number format, with signs of typography."""
    return _spaced(spoken(form.format(value)))


def _spaced(text: str) -> str:
    """Return text with plain spaces instead of narrow ones, which some terminals lack."""
    return text.replace("\u202f", " ")


def _change(key: str, bare: float, value: float | None) -> str:
    """Return a value with its unit and its change; empty where there is none."""
    if value is None or key in ERRORS:
        return _cell(key, value)
    change = _spaced(format_change(bare, value, key))
    return f"{_cell(key, value)} ({change})" if change != "–" else _cell(key, value)


def truth_table(rows: list[tuple[str, float, float, str]]) -> Table:
    """Return the table of found and true values; rows hold title, found value, true value and unit."""
    table = Table("against the phantom's truth", "unit", "found", "true", "error")
    for title, found, true, unit in rows:
        error = f"{found / true - 1:+.1%}" if true else f"{found - true:+.3g}"
        table.add_row(title, unit, f"{found:.4g}", f"{true:.4g}", error)
    return table


def device_table(devices: Mapping[str, Design]) -> Table:
    """Return the table of the catalogue: names, construction, sizes, and how well the numbers are sourced."""
    table = Table()
    # A name is typed as it stands: it is never cut, however narrow the terminal.
    table.add_column("name", no_wrap=True, min_width=max(map(len, devices), default=0))
    for title in ("device", "construction", "sizes, mm", "numbers with a cited source"):
        table.add_column(title, overflow="fold")
    for name, design in devices.items():
        cited = sum(fact.confidence == "cited" for fact in design.facts)
        diameters = sorted({size.diameter_mm for size in design.sizes})
        lengths = sorted({size.length_mm for size in design.sizes})
        spans = (
            " to ".join(dict.fromkeys(f"{mm:g}" for mm in (all_mm[0], all_mm[-1]))) for all_mm in (diameters, lengths)
        )
        sizes = f"{' x '.join(spans)} ({counted(len(design.sizes), 'size')})"
        table.add_row(name, design.name, design.kind.replace("_", "-"), sizes, f"{cited} of {len(design.facts)}")
    return table


def fit_table(fitted: Fitted) -> Table:
    """Return the table of fitted numbers: value, standard error, that of the prior, and whether it is determined."""
    table = Table("number", "value", "standard error", "before", "determined", title="fit")
    for name, value, error, before, is_determined in zip(
        fitted.names, fitted.values, fitted.errors, fitted.prior_errors, fitted.is_determined, strict=True
    ):
        is_angle = name.endswith("_rad")
        unit = "°" if is_angle else "µm" if name.endswith("_um") else "mm"
        cells = (f"{degrees(x):.2f} {unit}" if is_angle else f"{x:.3f} {unit}" for x in (value, error, before))
        table.add_row(_number_title(name), *cells, "yes" if is_determined else "no, as the similar device")
    residuals = fitted.residuals
    worst = int(abs(residuals).argmax())
    table.caption = (
        f"{len(residuals)} measurements; chi-squared {float((residuals**2).sum()):.1f}. Largest residual: "
        f"{residuals[worst]:+.1f} standard errors, {fitted.measurements[worst].where}."
    )
    table.caption_justify = "left"
    return table


def correlation_table(fitted: Fitted) -> Table:
    """Return the table of correlations of the fitted numbers."""
    table = Table("correlation", *(str(k) for k in range(1, len(fitted.names) + 1)))
    for k, (name, row) in enumerate(zip(fitted.names, fitted.correlation, strict=True), start=1):
        table.add_row(f"{k} {_number_title(name)}", *(_typed("{:+.2f}", value) for value in row))
    return table


def _number_title(name: str) -> str:
    """Return the display name of a fitted number."""
    base, _, label = name.partition(" ")
    if label:
        return f"{label} mm: length minus label"
    return "free diameter minus label" if base == MARGIN else number_name(base)
