"""Name, meaning and source of every metric in the report."""

import tomllib
from pathlib import Path
from typing import Final, NamedTuple


class Definition(NamedTuple):
    """Display name, meaning and source of one metric."""

    name: str
    """Display name."""
    meaning: str
    """Meaning, in one sentence."""
    source: str = ""
    """Publication that defines the metric; empty where the meaning suffices."""


_TABLE: Final = tomllib.loads((Path(__file__).parent / "assets" / "definitions.toml").read_text(encoding="utf-8"))
DEFINITIONS: Final = {key: Definition(**words) for key, words in _TABLE.items()} | {
    f"unexchanged_after_{moment}s_{key}": Definition(
        f"{what} without exchange, {moment} s",
        f"{what} of the sac where more than half of the blood is the same after {moment} s.",
    )
    for moment in (1, 2, 5)
    for key, what in (("volume_mm3", "Volume"), ("area_mm2", "Wall area"))
}
"""Definition of every metric by its key; the end of a key is its unit."""

INDICES_WITH_OCCLUSION: Final = (
    "Indices that studies associate with occlusion, not a prognosis:",
    "Volume of the sac with fast blood (8 cm/s or more; Beppu et al. 2020, AJNR 41:2107, 27 patients, divided by the "
    "volume of the dome).",
    "Reduction of the mean sac velocity: by 35 % or more in Ouared et al. 2016, J. Neurointerv. Surg. 8:1288 (not "
    "verified against the original); a trend "
    "only (p = 0.08) in Brina et al. 2019, AJNR 40:2117, 23 patients.",
)
"""Sentences on flow metrics that studies associate with occlusion after flow diversion."""

OF_PULSE: Final = (
    "In pulsatile flow every number is the mean over the last cycle, unless its name says largest; wall shear "
    "stress is the time average of its magnitude (TAWSS)."
)
"""Note on all flow metrics of a pulsatile flow."""

WANTED: Final = {"neck_inflow_mL_s": -1, "mean_sac_velocity_m_s": -1, "sac_kinetic_energy_J": -1, "turnover_time_s": 1}
"""Sign of the wanted change of a flow metric. Less and slower inflow is associated with occlusion; for other metrics
no direction is agreed on."""
HEADLINES: Final = (
    *("neck_inflow_mL_s", "neck_inflow_in_sac_mL_s", "neck_inflow_in_artery_mL_s"),
    *("mean_sac_velocity_m_s", "turnover_time_s", "mean_sac_wss_Pa", "low_shear_area_fraction"),
    *("contrast_preview_error_fraction", "contrast_retention_s", "contrast_mean_transit_s", "mean_sac_age_s"),
)
"""Keys of the flow metrics on the first screen of the report, the most important first."""
