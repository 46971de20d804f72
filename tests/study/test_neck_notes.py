"""The note on a neck inflow that exceeds the flow of the artery."""

import pytest

from vstent.study.stages import neck_notes


@pytest.mark.parametrize(("neck_mL_s", "is_told"), [(5.9, False), (6.1, True)])
def test_a_neck_inflow_above_that_of_all_inlets_is_told(neck_mL_s: float, is_told: bool) -> None:
    flow = {"inlet_flow_mL_s": 4.0, "inlet_2_flow_mL_s": 2.0, "outlet_1_flow_mL_s": 6.0, "neck_inflow_mL_s": neck_mL_s}
    notes = neck_notes({"treatments": {"bare": {"flow": flow}, "silk": {"implants": {}}}})
    assert len(notes) == is_told
    for note in notes:
        assert note.startswith("Flow, bare: the neck inflow, 6.10 mL/s, exceeds the 6.00 mL/s that enter the vessel")
