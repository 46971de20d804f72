"""Name, meaning and source of every metric in the report."""

from typing import Final, NamedTuple


class Definition(NamedTuple):
    """Display name, meaning and source of one metric."""

    name: str
    """Display name."""
    meaning: str
    """Meaning, in one sentence."""
    source: str = ""
    """Publication that defines the metric; empty where the meaning suffices."""


_DHAR: Final = "Dhar et al. 2008, Neurosurgery 63:185"
_RAGHAVAN: Final = "Raghavan, Ma and Harbaugh 2005, J. Neurosurg. 102:355"
_BAHAROGLU: Final = "Baharoglu et al. 2010, Stroke 41:1423"
_PICCINELLI: Final = "Piccinelli et al. 2009, IEEE Trans. Med. Imaging 28:1141"
_MEIER: Final = "Meier and Zierler 1954, J. Appl. Physiol. 6:731"
"""Publications that define metrics."""

DEFINITIONS: Final[dict[str, Definition]] = {
    # the artery and the sac
    "parent_proximal_diameter_mm": Definition(
        "Parent diameter, proximal",
        "Mean diameter of the parent artery over 5 mm proximal to the neck (circle of the same area).",
    ),
    "parent_distal_diameter_mm": Definition(
        "Parent diameter, distal",
        ("Mean diameter of the parent artery over 5 mm distal to the neck (circle of the same area)."),
    ),
    "sac_volume_mm3": Definition("Sac volume", "Volume of the lumen beyond the neck."),
    "sac_plane_volume_mm3": Definition("Sac volume, plane cut", "Volume of the sac beyond the neck plane.", _RAGHAVAN),
    "sac_area_mm2": Definition("Sac wall area", "Area of the sac's wall, without the neck."),
    "sac_height_mm": Definition(
        "Sac height", ("Largest distance of the dome from the neck plane, perpendicular to it."), _DHAR
    ),
    "sac_max_height_mm": Definition(
        "Sac height, longest", "Largest distance from the center of the neck to the dome.", _DHAR
    ),
    "sac_max_diameter_mm": Definition("Sac diameter, largest", "Largest distance between two points of the sac."),
    "neck_area_mm2": Definition("Neck area", "Area enclosed by the neck curve, projected on its mean plane."),
    "neck_plane_area_mm2": Definition(
        "Neck area, plane cut",
        "Area of the section by the neck plane, which separates the sac from all arteries with the least surface for "
        "its volume.",
        _RAGHAVAN,
    ),
    "neck_plane_area_low_mm2": Definition(
        "Neck area, plane cut, from", "Smallest area of the sections by planes that separate the sac nearly as well."
    ),
    "neck_plane_area_high_mm2": Definition(
        "Neck area, plane cut, to", "Largest area of the sections by planes that separate the sac nearly as well."
    ),
    "neck_surface_area_mm2": Definition("Neck surface", "Area of the restored wall that closes the neck."),
    "neck_perimeter_mm": Definition("Neck perimeter", "Length of the rim of the neck plane's section."),
    "neck_min_diameter_mm": Definition("Neck width, smallest", "Smallest width of the neck plane's section."),
    "neck_max_diameter_mm": Definition("Neck width, largest", "Largest width of the neck plane's section."),
    "aspect_ratio": Definition("Aspect ratio", "Sac height divided by the mean diameter of the neck.", _DHAR),
    "size_ratio": Definition("Size ratio", "Longest sac height divided by the parent artery's diameter.", _DHAR),
    "undulation_index": Definition(
        "Undulation index",
        "1 - V / Vh: volume V of the sac beyond the neck plane, Vh of its convex hull; 0 without dents and blebs.",
        _RAGHAVAN,
    ),
    "ellipticity_index": Definition(
        "Ellipticity index",
        "1 - (18 pi)^(1/3) Vh^(2/3) / Sh: volume and area of the convex hull without the neck plane; half sphere: 0.",
        _RAGHAVAN,
    ),
    "nonsphericity_index": Definition(
        "Nonsphericity index",
        "1 - (18 pi)^(1/3) V^(2/3) / S: volume and wall area of the sac beyond the neck plane; 0 for a half sphere.",
        _RAGHAVAN,
    ),
    "inflow_angle_rad": Definition(
        "Inflow angle",
        "Angle between the parent artery upstream of the neck and the longest height of the sac; 180° is straight "
        "ahead of the flow.",
        _BAHAROGLU,
    ),
    "diameter_threshold_band_mm": Definition(
        "Diameter band",
        "Change of every diameter when the threshold of the scan changes by 5 % of the step from tissue to lumen.",
    ),
    "parent_mean_curvature_per_mm": Definition(
        "Parent curvature, mean", "Mean curvature of the parent axis without its ends.", _PICCINELLI
    ),
    "parent_max_curvature_per_mm": Definition(
        "Parent curvature, largest", "Largest curvature of the parent axis without its ends.", _PICCINELLI
    ),
    "parent_mean_torsion_per_mm": Definition(
        "Parent torsion, mean", "Mean magnitude of the torsion of the parent axis where it is bent.", _PICCINELLI
    ),
    "neck_mean_curvature_per_mm": Definition(
        "Parent curvature at the neck", "Mean curvature of the parent axis along the neck.", _PICCINELLI
    ),
    # the device
    "label_diameter_mm": Definition("Label diameter", "Nominal diameter of the size."),
    "label_length_mm": Definition("Label length", "Nominal length of the size."),
    "deployed_length_mm": Definition("Deployed length", "Length along the parent axis between the ends of the device."),
    "mesh_length_mm": Definition(
        "Dense mesh, deployed length",
        "Length along the parent axis between the ends of the dense mesh of a dual-layer device. Its outer layer is "
        "longer.",
    ),
    "oversizing_fraction": Definition(
        "Oversizing", "Label diameter divided by the mean diameter of the artery along the device, minus one."
    ),
    "proximal_end_abscissa_mm": Definition(
        "Proximal end", "Position of the proximal end along the parent axis, from the inlet."
    ),
    "distal_end_abscissa_mm": Definition(
        "Distal end", ("Position of the distal end along the parent axis, from the inlet.")
    ),
    "min_diameter_mm": Definition(
        "Deployed diameter, smallest", "Smallest perimeter of a row of the device, divided by pi."
    ),
    "mean_diameter_mm": Definition("Deployed diameter, mean", "Mean perimeter of the device's rows, divided by pi."),
    "max_diameter_mm": Definition(
        "Deployed diameter, largest", "Largest perimeter of a row of the device, divided by pi."
    ),
    "neck_to_proximal_end_mm": Definition(
        "Landing zone, proximal",
        "Length of the device proximal to the neck, along the parent axis; of a dual-layer device its dense mesh.",
    ),
    "neck_to_distal_end_mm": Definition(
        "Landing zone, distal",
        "Length of the device distal to the neck, along the parent axis; of a dual-layer device its dense mesh.",
    ),
    "neck_covered_fraction": Definition(
        "Neck spanned", "100 % where the device spans the whole neck along the parent axis."
    ),
    "max_neck_gap_mm": Definition(
        "Neck gap, largest",
        "Largest clearance between the outer face of the device and the neck. It is large where the sac is on "
        "a fork with one branch stented, or where the device is not apposed.",
    ),
    "apposed_fraction": Definition(
        "Apposed", "Fraction of the device's nodes over the patient's own wall with a gap below 0.1 mm."
    ),
    "mean_wall_gap_mm": Definition(
        "Wall gap, mean", ("Mean clearance between the outer face of the device and the wall.")
    ),
    "max_wall_gap_mm": Definition(
        "Wall gap, largest", "Largest clearance between the outer face of the device and the wall."
    ),
    "malapposition_volume_mm3": Definition(
        "Malapposition volume", "Volume between the outer face of the device and the wall."
    ),
    "max_outside_mm": Definition(
        "Outside the artery, largest", "Largest distance of a node outside the landing surface; 0 in a good deployment."
    ),
    "metal_coverage_fraction": Definition(
        "Metal coverage",
        "Fraction of the device's surface covered by metal, measured on the deployed wires; of a dual-layer device "
        "where it has both layers.",
    ),
    "metal_coverage_formula_fraction": Definition(
        "Metal coverage, formula",
        "At the mean deployed diameter: 1 - (1 - f)² for crossing wires, with f the fraction covered by the "
        "wires of one direction; 2 f for struts that meet without crossing.",
    ),
    "neck_metal_coverage_fraction": Definition(
        "Metal coverage on the neck",
        ("Fraction of the device's surface over the neck covered by metal (on a fork: the part that faces the neck)."),
    ),
    "pore_density_per_mm2": Definition(
        "Pore density", "Number of pores per area of the device, measured on the deployed wires."
    ),
    "pore_density_formula_per_mm2": Definition(
        "Pore density, formula",
        "At the mean deployed diameter D, for n wires at an angle a to the axis: 2 (n/2)² tan(a) / (pi D)²; for open "
        "cells times the fraction of joined crowns.",
    ),
    "neck_pore_density_per_mm2": Definition(
        "Pore density on the neck", ("Number of pores per area of the device over the neck.")
    ),
    "iterations_count": Definition("Iterations", "Iterations of the active contour (the paper: 7 on average)."),
    "terminated_fraction": Definition(
        "Nodes terminated",
        ("Fraction of the nodes that reached the wall or the free diameter; the contour stops at 99 %."),
    ),
    "jailed_branches_count": Definition(
        "Jailed branches", ("Number of branches that leave the artery between the ends of the device.")
    ),
    "proximal_end_to_branch_mm": Definition(
        "Proximal end to branch", "Distance along the artery from the proximal end of the device to the nearest branch."
    ),
    "distal_end_to_branch_mm": Definition(
        "Distal end to branch", "Distance along the artery from the distal end of the device to the nearest branch."
    ),
    "mean_wire_stretch_fraction": Definition(
        "Wire stretch, mean", "Mean relative change of length of the wires between crossings; 0 is exact."
    ),
    "p95_wire_stretch_fraction": Definition(
        "Wire stretch, 95 %", "95 % of the wires between crossings change their length by less than this."
    ),
    "min_cell_width_fraction": Definition(
        "Cell width, smallest",
        "Smallest width of a cell around the artery, seen from the axis, relative to the same cell in a straight "
        "artery of the same diameter; 0 if it is closed or on edge, negative if it is turned over.",
    ),
    "narrowest_cell_abscissa_mm": Definition("Narrowest cell", "Position of the narrowest cell along the parent axis."),
    "narrowest_cell_angle_rad": Definition(
        "Narrowest cell, angle to the inside of the bend",
        "Angle around the axis between the narrowest cell and the inner side of the bend: 0 inside, 180° outside.",
    ),
    "crumpled_cells_count": Definition(
        "Crumpled cells", "Number of cells narrower than a quarter of their width in a straight artery."
    ),
    "crumpled_cells_fraction": Definition(
        "Crumpled cells, fraction", "Fraction of the cells narrower than a quarter of their width in a straight artery."
    ),
    "free_crowns_count": Definition(
        "Free crowns", "Number of crowns of an open-cell device that are joined to no other."
    ),
    "max_crown_outward_mm": Definition(
        "Free crown outside the artery, largest",
        "Largest distance of the tip of a free crown outside the landing surface, over a neck or an ostium.",
    ),
    "max_crown_inward_mm": Definition(
        "Free crown in the lumen, largest",
        "Largest clearance between the outer face of a free crown's tip and the landing surface.",
    ),
    # the flow
    "inlet_flow_mL_s": Definition("Inlet flow", "Flow of blood through the inlet."),
    "outlet_flow_mL_s": Definition("Outlet flow", "Flow of blood through the outlet."),
    "neck_inflow_mL_s": Definition(
        "Neck inflow",
        "Integral over the section by the neck plane of the velocity component into the sac; over the opening of the "
        "sac where there is no neck plane.",
    ),
    "neck_inflow_in_sac_mL_s": Definition(
        "Neck inflow, 0.5 mm into the sac",
        "The same integral over the section of the sac 0.5 mm beyond the neck plane.",
    ),
    "neck_inflow_in_artery_mL_s": Definition(
        "Neck inflow, 0.5 mm into the artery",
        "The same integral over the outline of the neck, moved 0.5 mm from the neck plane into the artery.",
    ),
    "opening_inflow_mL_s": Definition(
        "Inflow through the sac's opening",
        "The same integral over the surface that closes the sac, which may be curved and extend along the artery.",
    ),
    "turnover_time_s": Definition("Turnover time", "Sac volume divided by neck inflow."),
    "mean_sac_velocity_m_s": Definition(
        "Mean sac velocity",
        "Mean speed in the sac. Studies associate a reduction of 35 % or more with occlusion.",
    ),
    "mean_sac_oscillatory_shear_fraction": Definition(
        "Sac oscillatory shear index", "Mean over the sac wall of (1 - |mean stress| / mean |stress|) / 2."
    ),
    "mean_sac_wss_Pa": Definition(
        "Wall shear stress on the sac, mean", "Mean magnitude of the wall shear stress over the sac wall."
    ),
    "max_sac_wss_Pa": Definition(
        "Wall shear stress on the sac, largest",
        "Largest magnitude of the wall shear stress on the sac wall; in a pulse at any time.",
    ),
    "parent_wss_Pa": Definition(
        "Wall shear stress on the parent artery, mean",
        ("Mean magnitude of the wall shear stress over the parent artery's own wall."),
    ),
    "low_shear_area_fraction": Definition(
        "Low shear area", "Fraction of the sac wall with a wall shear stress below 0.4 Pa."
    ),
    "mean_sac_pressure_Pa": Definition("Sac pressure, mean", "Mean pressure in the sac, relative to the outlets."),
    "fast_sac_volume_mm3": Definition("Fast sac volume", "Volume of the sac with a speed above 8 cm/s."),
    "max_sac_velocity_m_s": Definition("Largest sac velocity", "Largest speed in the sac; in a pulse at any time."),
    "neck_outflow_mL_s": Definition("Neck outflow", "Integral over the neck of the velocity component out of the sac."),
    "sac_kinetic_energy_J": Definition("Kinetic energy of the sac", "Integral over the sac of density u² / 2."),
    "inflow_area_fraction": Definition("Inflow area", "Fraction of the neck where blood enters the sac."),
    "inflow_concentration_index": Definition(
        "Inflow concentration",
        "(Neck inflow / flow of all inlets) / (inflow area / neck area).",
        "Cebral et al. 2011, AJNR 32:145",
    ),
    "relative_low_shear_area_fraction": Definition(
        "Low shear area, relative",
        "Fraction of the sac wall below a tenth of the parent artery's mean wall shear stress.",
    ),
    "mean_wss_Pa": Definition(
        "Wall shear stress, mean", ("Mean magnitude of the wall shear stress over the whole wall.")
    ),
    "inlet_pressure_Pa": Definition("Inlet pressure", "Mean pressure over the inlet, relative to the outlets."),
    "pressure_drop_Pa": Definition("Pressure drop", "Pressure at the inlet minus pressure at the widest outlet."),
    "grid_spacing_mm": Definition("Grid spacing", "Distance between neighboring cells of the flow's grid."),
    "cells_count": Definition("Cells", "Number of cells of blood; coarse cells that contain finer ones do not count."),
    "steps_count": Definition("Time steps", "Number of time steps or iterations on the finest grid."),
    "inflow_mL_s": Definition("Inflow", "Mean flow rate through all inlets together."),
    "inlet_reynolds_number_count": Definition(
        "Reynolds number", "Mean speed × diameter / kinematic viscosity at the widest inlet."
    ),
    "cells_across_neck_count": Definition(
        "Cells across the neck", "Diameter of a circle with the area of the neck / grid spacing."
    ),
    "cells_across_sac_count": Definition(
        "Cells across the sac", "Diameter of a sphere with the volume of the sac / grid spacing."
    ),
    "cells_across_parent_count": Definition(
        "Cells across the parent artery",
        "Inscribed diameter within 10 mm of the neck (lower quartile of the widest path) / grid spacing.",
    ),
    "cells_across_outlet_count": Definition(
        "Cells across an outlet",
        "Diameter of the narrowest outlet with at least 4 % of the outflow by Murray's law / grid spacing.",
    ),
    "raised_viscosity_fraction": Definition(
        "Raised viscosity",
        "Fraction of the cells in the sac and around the neck in which the viscosity is raised for stability.",
    ),
    "neck_imbalance_fraction": Definition(
        "Neck imbalance",
        "Part of the neck inflow that leaves neither through the neck nor through a branch of the sac.",
    ),
    "unsettled_fraction": Definition(
        "Convergence error",
        "Estimated relative distance from convergence of sac speed, neck inflow, inlet pressure and mean "
        "speed. Of an unsteady flow: three standard errors of the means, or the range where there are too few "
        "checks. Of a pulse: change between its last two cycles.",
    ),
    # the angiogram
    "contrast_preview_error_fraction": Definition(
        "Preview of contrast, error",
        "The contrast numbers are a preview on a grid twice as coarse. The percentage is the largest error of "
        "retention measured on the demo; the mean age was 7 to 27 % too short there.",
    ),
    "contrast_arrival_s": Definition(
        "Contrast arrival",
        "Time from the start of the injection until the mean iodine of the sac reaches a tenth of its peak.",
    ),
    "contrast_peak_s": Definition(
        "Contrast peak, time", "Time from the start of the injection until the mean iodine of the sac peaks."
    ),
    "contrast_peak_mg_mL": Definition("Contrast peak", "Largest mean iodine concentration of the sac."),
    "contrast_peak_fraction": Definition(
        "Contrast peak, relative",
        "Largest mean iodine concentration of the sac divided by that of the parent artery proximal to the neck.",
    ),
    "washout_half_life_s": Definition(
        "Washout half-life", "Time from the peak of the sac's mean iodine until it falls to half."
    ),
    "contrast_retention_s": Definition(
        "Contrast retention",
        "Time by which the sac falls to half of its peak later than the parent artery. Hadad et al. 2023 found "
        "stagnation above 0.46 s of their retention time (14 aneurysms), whose definition may differ.",
        "after Hadad et al. 2023, Int. J. Num. Methods Biomed. Eng. 39:e3740",
    ),
    "contrast_mean_transit_s": Definition(
        "Mean transit time", "Centroid of the sac's curve in time minus that of the parent artery's.", _MEIER
    ),
    "contrast_balance_error_fraction": Definition(
        "Contrast balance", "Contrast that entered minus that which left or is inside, relative to what entered."
    ),
    "mean_sac_age_s": Definition(
        "Age of the sac's blood", "Mean time that the blood in the sac has been there (integral of the washout)."
    ),
    "sac_age_extrapolated_fraction": Definition(
        "Age, extrapolated part", "Part of the mean age that lies beyond the computed washout."
    ),
} | {
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

WANTED: Final = {
    "neck_inflow_mL_s": -1,
    "neck_inflow_in_sac_mL_s": -1,
    "neck_inflow_in_artery_mL_s": -1,
    "opening_inflow_mL_s": -1,
    "mean_sac_velocity_m_s": -1,
    "sac_kinetic_energy_J": -1,
    "turnover_time_s": 1,
}
"""Sign of the wanted change of a flow metric. Less and slower inflow is associated with occlusion; for other metrics
no direction is agreed on."""
HEADLINES: Final = (
    "neck_inflow_mL_s",
    "neck_inflow_in_sac_mL_s",
    "neck_inflow_in_artery_mL_s",
    "mean_sac_velocity_m_s",
    "turnover_time_s",
    "mean_sac_wss_Pa",
    "low_shear_area_fraction",
    "contrast_preview_error_fraction",
    "contrast_retention_s",
    "contrast_mean_transit_s",
    "mean_sac_age_s",
)
"""Keys of the flow metrics on the first screen of the report, the most important first."""
