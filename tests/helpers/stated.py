"""Every option of the settings with a text, and the settings that it states."""

from vstent.devices.treatment import read_treatment, with_device
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.plan.ranges import Ranges
from vstent.study.settings import AnatomySettings, InputSettings, Settings

USUAL = ("silk", "enterprise")
NECK = "1,2,3\n4,5,6\n7,8,9\n"
"""Content of the file ``neck.csv``."""
OUTLETS = "R_p (Pa s/m3), C (m3/Pa), R_d\n6e8,1e-9,9e8\n"
"""Content of the file ``outlets.csv``."""
STATED = {
    "units": ("cm", Settings(InputSettings(units="cm"))),
    "frame": ("ras", Settings(InputSettings(frame="ras"))),
    "acquisition": ("2", Settings(InputSettings(acquisition=2))),
    "spacing": ("0.1 0.2 0.3", Settings(InputSettings(spacing_mm=(0.1, 0.2, 0.3)))),
    "shape": ("5 6 7", Settings(InputSettings(shape=(5, 6, 7)))),
    "crop": ("0 0 0 1 2 3", Settings(InputSettings(crop_mm=((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))))),
    "threshold": ("-5.5", Settings(InputSettings(threshold=-5.5))),
    "at": ("-1.5, 0; 3", Settings(anatomy=AnatomySettings(at_mm=(-1.5, 0.0, 3.0)))),
    "inlet": ("1 2 3; 4 5 -6", Settings(anatomy=AnatomySettings(inlet_mm=((1.0, 2.0, 3.0), (4.0, 5.0, -6.0))))),
    "outlet": ("1 2 3", Settings(anatomy=AnatomySettings(outlet_mm=(1.0, 2.0, 3.0)))),
    "neck": (
        "neck.csv",
        Settings(anatomy=AnatomySettings(neck_mm=((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0)))),
    ),
    "no-aneurysm": ("yes", Settings(anatomy=AnatomySettings(without_aneurysm=True))),
    "upstream": ("9", Settings(anatomy=AnatomySettings(upstream_mm=9.0))),
    "downstream": ("8", Settings(anatomy=AnatomySettings(downstream_mm=8.0))),
    "treatment": (
        "two=silk 4x20 + silk@-4; coils(20%, seed 3)",
        Settings(treatments=(read_treatment("two=silk 4x20 + silk@-4"), read_treatment("coils(20%, seed 3)"))),
    ),
    "device": ("silk pipeline", Settings(treatments=(with_device("silk"), with_device("pipeline")))),
    "diameter": ("4.5", Settings(treatments=tuple(with_device(one, diameter_mm=4.5) for one in USUAL))),
    "length": ("20", Settings(treatments=tuple(with_device(one, length_mm=20.0) for one in USUAL))),
    "center": ("-2", Settings(treatments=tuple(with_device(one, center_mm=-2.0) for one in USUAL))),
    "straightening": ("12deg", Settings(straightening="12deg")),
    "no-flow": ("yes", Settings(flow=None)),
    "inlet-speed": ("0.3", Settings(flow=FlowSettings(inlet_speed_m_s=0.3))),
    "flow-rate": ("270 mL/min", Settings(flow=FlowSettings(inflow_mL_s=4.5))),
    "density": ("1050", Settings(flow=FlowSettings(blood=Blood(1050.0)))),
    "viscosity": ("0.0035", Settings(flow=FlowSettings(blood=Blood(viscosity_Pa_s=0.0035)))),
    "shear-thinning": ("yes", Settings(flow=FlowSettings(blood=Blood(1060.0, 0.00345, CarreauYasuda())))),
    "pulsatile": ("ica_older_adults", Settings(flow=FlowSettings(waveform=OLDER_ADULT_ICA))),
    "steady": ("yes", Settings()),
    "outlets": ("murray", Settings(flow=FlowSettings(outlets="murray"))),
    "inlet-profile": ("plug", Settings(flow=FlowSettings(profile="plug"))),
    "outlet-shares": ("3, 2, 1", Settings(flow=FlowSettings(shares=(3.0, 2.0, 1.0)))),
    "outlet-table": ("outlets.csv", Settings(flow=FlowSettings(elements=((600.0, 0.001, 900.0),)))),
    "outlet-exponent": ("2", Settings(flow=FlowSettings(outlet_exponent=2.0))),
    "mean-pressure": ("100", Settings(flow=FlowSettings(mean_pressure_mmHg=100.0))),
    "windkessel-time": ("0.5", Settings(flow=FlowSettings(compliance_time_s=0.5))),
    "windkessel-proximal": ("0.1", Settings(flow=FlowSettings(proximal_fraction=0.1))),
    "grid-spacing": ("0.2", Settings(flow=FlowSettings(numerics=Numerics(cell_size_mm=0.2)))),
    "refine": (
        "sac; inlet; branches; 1,-2,3.5,4",
        Settings(flow=FlowSettings(numerics=Numerics(refine=("sac", "inlet", "branches", (1.0, -2.0, 3.5, 4.0))))),
    ),
    "wires": ("resolved", Settings(flow=FlowSettings(numerics=Numerics(wires="resolved")))),
    "engine": ("openfoam", Settings(flow=FlowSettings(numerics=Numerics(engine="openfoam")))),
    "processes": ("2", Settings(flow=FlowSettings(numerics=Numerics(processes=2)))),
    "gpu": ("yes", Settings(flow=FlowSettings(numerics=Numerics(device_gpu=True)))),
    "uncertainty": ("8", Settings(uncertainty=Ranges(8))),
    "uncertainty-flows": ("2", Settings(uncertainty=Ranges(8, 2))),
    "vary-threshold": ("0.2", Settings(uncertainty=Ranges(8, threshold_mm=0.2))),
    "vary-landing": ("2", Settings(uncertainty=Ranges(8, landing_mm=2.0))),
    "vary-device": ("0", Settings(uncertainty=Ranges(8, device_mm=0.0))),
    "vary-inflow": ("0.1", Settings(uncertainty=Ranges(8, inflow_fraction=0.1))),
    "vary-numbers": ("0.5", Settings(uncertainty=Ranges(8, numbers_factor=0.5))),
}
"""Text of every option, and the settings that it gives beside what `needed` returns."""


def needed(option: str) -> dict[str, object]:
    """What must be given for an option to have an effect, as values of options."""
    if option == "steady":
        return {"pulsatile": "ica_older_adults"}
    return {"uncertainty": 8} if option.startswith(("vary", "uncertainty-")) else {}
