"""What each number of the metrics means, and who defined it."""

from typing import Final, NamedTuple


class Definition(NamedTuple):
    """The words for one metric."""

    name: str
    """Name for people."""
    meaning: str
    """One sentence."""
    source: str = ""
    """Publication; empty where the meaning says all."""


_DHAR: Final = "Dhar et al. 2008, Neurosurgery 63:185"
_RAGHAVAN: Final = "Raghavan, Ma and Harbaugh 2005, J. Neurosurg. 102:355"
_PICCINELLI: Final = "Piccinelli et al. 2009, IEEE Trans. Med. Imaging 28:1141"

DEFINITIONS: Final[dict[str, Definition]] = {
    # the artery and the sac
    "parent_proximal_diameter_mm": Definition(
        "Parent diameter, proximal",
        "Diameter of the circle with the area of the parent artery's section before the neck.",
    ),
    "parent_distal_diameter_mm": Definition(
        "Parent diameter, distal", "Diameter of the circle with the area of the parent artery's section after the neck."
    ),
    "sac_volume_mm3": Definition("Sac volume", "Volume of the lumen beyond the neck."),
    "sac_plane_volume_mm3": Definition(
        "Sac volume, plane cut", "Volume of the sac beyond the neck plane: the neck curve's mean plane.", _RAGHAVAN
    ),
    "sac_area_mm2": Definition("Sac wall area", "Area of the sac's wall, without the neck."),
    "sac_height_mm": Definition("Sac height", "Largest distance of the dome from the neck plane, square to it.", _DHAR),
    "sac_max_height_mm": Definition(
        "Sac height, longest", "Longest distance from the neck's center to the dome.", _DHAR
    ),
    "sac_max_diameter_mm": Definition("Sac diameter, largest", "Largest distance between two points of the sac."),
    "neck_area_mm2": Definition("Neck area", "Area of the neck curve projected on its own mean plane."),
    "neck_plane_area_mm2": Definition(
        "Neck area, plane cut",
        "Area of the sac's largest section by the neck plane; left out where the artery's wall parts that section.",
        _RAGHAVAN,
    ),
    "neck_surface_area_mm2": Definition("Neck surface", "Area of the restored wall that closes the neck."),
    "neck_perimeter_mm": Definition("Neck perimeter", "Length of the neck curve."),
    "neck_min_diameter_mm": Definition("Neck width, smallest", "Smallest width of the neck curve in its mean plane."),
    "neck_max_diameter_mm": Definition("Neck width, largest", "Largest width of the neck curve in its mean plane."),
    "aspect_ratio": Definition("Aspect ratio", "Sac height divided by the mean diameter of the neck.", _DHAR),
    "size_ratio": Definition("Size ratio", "Longest sac height divided by the parent artery's diameter.", _DHAR),
    "diameter_threshold_band_mm": Definition(
        "Diameter band",
        "Every diameter grows by this where the scan's threshold is lower by 5 % of the step from tissue to lumen, and "
        "shrinks by it where higher.",
    ),
    "parent_mean_curvature_per_mm": Definition(
        "Parent curvature, mean", "Mean curvature of the parent axis, its ends left out.", _PICCINELLI
    ),
    "parent_max_curvature_per_mm": Definition(
        "Parent curvature, largest", "Largest curvature of the parent axis, its ends left out.", _PICCINELLI
    ),
    "parent_mean_torsion_per_mm": Definition(
        "Parent torsion, mean", "Mean magnitude of the torsion of the parent axis where that is bent.", _PICCINELLI
    ),
    "neck_mean_curvature_per_mm": Definition(
        "Parent curvature at the neck", "Mean curvature of the parent axis along the neck.", _PICCINELLI
    ),
    # the device
    "label_diameter_mm": Definition("Diameter on the label", "Diameter the device is sold as."),
    "label_length_mm": Definition("Length on the label", "Length the device is sold as."),
    "deployed_length_mm": Definition(
        "Deployed length", "Length along the parent axis between the ends; the wires keep their own length."
    ),
    "oversizing_fraction": Definition(
        "Oversizing", "Label diameter divided by the artery's mean diameter where the device lies, less one."
    ),
    "proximal_end_abscissa_mm": Definition(
        "Proximal end", "Where the device begins, along the parent axis from the inlet."
    ),
    "distal_end_abscissa_mm": Definition("Distal end", "Where the device ends, along the parent axis from the inlet."),
    "min_diameter_mm": Definition(
        "Deployed diameter, smallest", "Smallest perimeter of a row of the device, divided by pi."
    ),
    "mean_diameter_mm": Definition("Deployed diameter, mean", "Mean perimeter of the device's rows, divided by pi."),
    "max_diameter_mm": Definition(
        "Deployed diameter, largest", "Largest perimeter of a row of the device, divided by pi."
    ),
    "neck_to_proximal_end_mm": Definition(
        "Landing zone, proximal", "Length of device before the neck, along the parent axis."
    ),
    "neck_to_distal_end_mm": Definition(
        "Landing zone, distal", "Length of device after the neck, along the parent axis."
    ),
    "neck_covered_fraction": Definition(
        "Neck spanned", "100 % where the device begins before the neck and ends after it."
    ),
    "max_neck_gap_mm": Definition(
        "Neck gap, largest",
        "Largest clearance between the device's outer face and the neck: large where the sac sits on a fork, of which "
        "one branch alone is stented, or where the device stands off the wall.",
    ),
    "apposed_fraction": Definition(
        "Apposed", "Part of the device's nodes beside the patient's own wall that are nearer to it than 0.1 mm."
    ),
    "mean_wall_gap_mm": Definition("Wall gap, mean", "Mean clearance between the device's outer face and the wall."),
    "max_wall_gap_mm": Definition(
        "Wall gap, largest", "Largest clearance between the device's outer face and the wall."
    ),
    "malapposition_volume_mm3": Definition(
        "Malapposition volume", "Volume between the device's outer face and the wall."
    ),
    "max_outside_mm": Definition(
        "Outside the artery, largest", "Largest distance of a node beyond the landing surface; a good deployment has 0."
    ),
    "metal_coverage_fraction": Definition(
        "Metal coverage", "Part of the device's surface under wires, measured on the wires as they lie."
    ),
    "metal_coverage_formula_fraction": Definition(
        "Metal coverage, formula",
        "At the mean deployed diameter: 1 - (1 - f)² for crossing wires, f the part that the wires of one hand cover; "
        "2 f for struts that meet without crossing.",
    ),
    "neck_metal_coverage_fraction": Definition(
        "Metal coverage on the neck", "Part of the device over the neck (on a fork: facing it) under wires."
    ),
    "pore_density_per_mm2": Definition(
        "Pore density", "Pores per area of the device, measured on the wires as they lie."
    ),
    "pore_density_formula_per_mm2": Definition(
        "Pore density, formula",
        "At the mean deployed diameter D, for n wires at the angle a to the axis: 2 (n/2)² tan(a) / (pi D)².",
    ),
    "neck_pore_density_per_mm2": Definition("Pore density on the neck", "Pores per area of the device over the neck."),
    "iterations_count": Definition("Iterations", "Steps of the active contour until it stopped (the paper needs 7)."),
    "terminated_fraction": Definition(
        "Nodes terminated", "Part of the nodes that reached the wall or the free diameter; the contour stops at 99 %."
    ),
    "jailed_branches_count": Definition("Jailed branches", "Branches that leave the artery between the device's ends."),
    "proximal_end_to_branch_mm": Definition(
        "Proximal end to branch", "Along the artery, from the proximal end of the device to the nearest branch."
    ),
    "distal_end_to_branch_mm": Definition(
        "Distal end to branch", "Along the artery, from the distal end of the device to the nearest branch."
    ),
    "mean_wire_stretch_fraction": Definition(
        "Wire stretch, mean", "By how much pieces of wire between crossings are longer than made: 0 is right."
    ),
    "p95_wire_stretch_fraction": Definition(
        "Wire stretch, 95 %", "95 % of the pieces of wire between crossings stretch or shorten by less than this."
    ),
    # the flow
    "inlet_flow_mL_s": Definition("Inlet flow", "Blood that enters through the inlet."),
    "outlet_flow_mL_s": Definition("Outlet flow", "Blood that leaves through the outlet."),
    "neck_inflow_mL_s": Definition(
        "Neck inflow", "Integral over the neck of the velocity where it points into the sac."
    ),
    "turnover_time_s": Definition("Turnover time", "Sac volume divided by neck inflow."),
    "mean_sac_velocity_m_s": Definition(
        "Mean sac velocity",
        "Mean magnitude of the velocity over the sac; a reduction by 35 % or more has been associated with occlusion.",
    ),
    "mean_sac_oscillatory_shear_fraction": Definition(
        "Sac oscillatory shear index", "Area mean over the sac's wall of (1 - |mean stress| / mean |stress|) / 2."
    ),
    "mean_sac_wss_Pa": Definition(
        "Wall shear stress on the sac, mean", "Area mean over the sac's wall of the magnitude of the wall shear stress."
    ),
    "max_sac_wss_Pa": Definition(
        "Wall shear stress on the sac, largest",
        "Largest magnitude of the wall shear stress on the sac's wall; of a pulse in any of its moments.",
    ),
    "parent_wss_Pa": Definition(
        "Wall shear stress on the parent artery, mean", "Area mean of its magnitude over the parent artery's own wall."
    ),
    "low_shear_area_fraction": Definition(
        "Low shear area", "Part of the sac's wall with a wall shear stress below 0.4 Pa."
    ),
    "mean_sac_pressure_Pa": Definition("Sac pressure, mean", "Mean over the sac's volume, above that of the outlets."),
    "fast_sac_volume_mm3": Definition("Fast sac volume", "Volume of the sac with a speed above 8 cm/s."),
    "max_sac_velocity_m_s": Definition(
        "Largest sac velocity", "Largest magnitude of the velocity in the sac; of a pulse in any of its moments."
    ),
    "neck_outflow_mL_s": Definition("Neck outflow", "Integral over the neck of the velocity where it leaves the sac."),
    "sac_kinetic_energy_J": Definition("Kinetic energy of the sac", "Integral over the sac of density u² / 2."),
    "inflow_area_fraction": Definition("Inflow area", "Part of the neck where blood enters the sac."),
    "inflow_concentration_index": Definition(
        "Inflow concentration",
        "(Neck inflow / flow of all inlets) / (inflow area / neck area).",
        "Cebral et al. 2011, AJNR 32:145",
    ),
    "relative_low_shear_area_fraction": Definition(
        "Low shear area, relative",
        "Part of the sac's wall below a tenth of the parent artery's mean wall shear stress.",
    ),
    "mean_wss_Pa": Definition("Wall shear stress, mean", "Area mean of its magnitude over the whole wall."),
    "inlet_pressure_Pa": Definition("Inlet pressure", "Mean over the inlet's section, above that of the outlets."),
    "pressure_drop_Pa": Definition("Pressure drop", "Inlet pressure less that of the widest outlet."),
    "unsettled_fraction": Definition(
        "Left to settle",
        "What the sac's mean speed, neck inflow, inlet pressure or the vessel's mean speed has left to go; where they "
        "swing, three standard errors of their means, or what they range over if checks are too few to tell; of a "
        "pulse, what its last two cycles differ by.",
    ),
}

OF_PULSE: Final = (
    "Of a pulse every number of the flow is the mean over its last cycle, unless it is called largest; wall shear "
    "stress is the time average of its magnitude (TAWSS)."
)
"""What holds for all numbers of the flow."""

HEADLINES: Final = (
    "neck_inflow_mL_s",
    "mean_sac_velocity_m_s",
    "turnover_time_s",
    "mean_sac_wss_Pa",
    "low_shear_area_fraction",
)
"""The numbers for the first screen, the most telling first."""
