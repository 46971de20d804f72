"""The flow divided fork by fork along the centerlines, and resistances of outlets from a table."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.errors import InputError
from vstent.flow.ends import Resistance, ends_of
from vstent.flow.forks import shares_by_forks
from vstent.flow.settings import FlowSettings, read_elements
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Opening, Vessel
from vstent.units import PA_PER_MMHG


def tree(*ways: list[tuple[float, float, float]]) -> Vessel:
    """A vessel of centerlines only: each way is a list of (length, direction in degrees, radius) from the inlet."""
    lines, ends = [], []
    for way in ways:
        points, radius = [np.zeros(3)], [way[0][2]]
        for length_mm, degrees, radius_mm in way:
            step = 0.1 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
            for _ in range(round(length_mm / 0.1)):
                points.append(points[-1] + step)
                radius.append(radius_mm)
        lines.append(Centerline(np.array(points), np.array(radius)))
        ends.append(Opening(points[-1], step / 0.1, np.pi * way[-1][2] ** 2, f"outlet_{len(lines)}"))
    inlet = Opening(np.zeros(3), np.array([-1.0, 0.0, 0.0]), np.pi * ways[0][0][2] ** 2, "inlet")
    wall = Surface(np.eye(3), np.array([[0, 1, 2]], dtype=np.int32))
    return Vessel(wall, (inlet, *ends), tuple(lines))


TRUNK = (10.0, 0.0, 2.0)


def test_each_fork_divides_what_reaches_it() -> None:
    """A trunk into branches of 3 and 2 mm; the second goes on into 2 and 1 mm."""
    vessel = tree(
        [TRUNK, (15.0, 45.0, 1.5)],
        [TRUNK, (10.0, -45.0, 1.0), (10.0, 0.0, 1.0)],
        [TRUNK, (10.0, -45.0, 1.0), (10.0, -90.0, 0.5)],
    )
    first = np.array([27.0, 8.0]) / 35
    np.testing.assert_allclose(shares_by_forks(vessel, 3.0), [first[0], first[1] * 8 / 9, first[1] / 9])
    # All outlets at once would give the last two less.
    cubes = np.array([27.0, 8.0, 1.0])
    assert shares_by_forks(vessel, 3.0)[1] < 0.93 * (cubes / cubes.sum())[1]


def test_three_branches_of_one_fork_are_divided_at_once_and_one_outlet_takes_all() -> None:
    ways = [[TRUNK, (12.0, degrees, radius)] for degrees, radius in ((60.0, 1.5), (0.0, 1.0), (-60.0, 0.5))]
    squares = np.array([1.5, 1.0, 0.5]) ** 2
    np.testing.assert_allclose(shares_by_forks(tree(*ways), 2.0), squares / squares.sum())
    assert shares_by_forks(tree(ways[0]), 3.0) == [1.0]


@cache
def fork() -> Vessel:
    straight = phantoms.tube(length_mm=14.0, radius_mm=2.0)
    phantom = phantoms.with_branch(straight, abscissa_mm=6.0, direction=[1, 0, 1], radius_mm=1.2, length_mm=7.0)
    return trace(Vessel(phantoms.phantom_surface(phantom)))


def test_split_and_resistance_use_the_diameters_behind_the_fork() -> None:
    share = shares_by_forks(fork(), 3.0)
    assert share[1] == pytest.approx(1.2**3 / (1.2**3 + 2.0**3), rel=0.05)
    settings = FlowSettings(inflow_mL_s=2.0, outlets="resistance")
    asked = [end.mean_mL_s for end in ends_of(fork(), settings)[1:] if isinstance(end, Resistance)]
    np.testing.assert_allclose(asked, 2.0 * share)


MIDDLE, ANTERIOR = (5.97e9, 1.16e-10), (8.48e9, 8.2e-11)
"""R, Pa s/m3, and C, m3/Pa, of the middle and anterior cerebral artery in Alastruey et al. 2007."""


def test_published_terminal_values_divide_the_flow_as_published(tmp_path: Path) -> None:
    """The share of the middle and the anterior cerebral artery is 59 : 41, and R C is 0.69-0.70 s, our default."""
    path = tmp_path / "circle.csv"
    rows = "\n".join(f"{0.44 * whole:g}, {stored:g}, {0.56 * whole:g}" for whole, stored in (MIDDLE, ANTERIOR))
    path.write_text(f"R_p (Pa s/m3), C (m3/Pa), R_d (Pa s/m3)\n{rows}\n")
    settings = FlowSettings(inflow_mL_s=3.0, outlets="windkessel", elements=read_elements(str(path)))
    first, second = (end for end in ends_of(fork(), settings) if isinstance(end, Resistance))
    np.testing.assert_allclose([first.mean_mL_s / 3, second.mean_mL_s / 3], [0.59, 0.41], atol=0.005)
    for end in (first, second):
        assert end.compliance_time_s == pytest.approx(FlowSettings().compliance_time_s, abs=0.01)
        assert end.proximal_fraction == pytest.approx(FlowSettings().proximal_fraction)
    # 3 mL/s through both would need a mean pressure of
    assert first.pressure_Pa / PA_PER_MMHG == pytest.approx(78.8, abs=0.1)
    plain = ends_of(fork(), replace(settings, outlets="resistance"))[1]
    assert plain == replace(first, compliance_time_s=0.0, proximal_fraction=1.0)


@pytest.mark.parametrize(
    ("titles", "value"), [("R (mmHg s/mL)", 10.0), ("R (dyn*s/cm5)", 13332.2), ("r (pa s/m3)", 1.33322e9)]
)
def test_units_of_a_table_are_those_of_its_titles(titles: str, value: float, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{titles}\n{value}\n{2 * value}\n")
    expected = [(10 * PA_PER_MMHG, 0.0, 0.0), (20 * PA_PER_MMHG, 0.0, 0.0)]
    np.testing.assert_allclose(read_elements(str(path)), expected, rtol=1e-5)


def test_a_table_without_units_or_of_another_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("R\n1\n2\n3\n")
    with pytest.raises(InputError, match=r"state no unit of the resistances: write 'R_p \(mmHg s/mL\), C, R_d'"):
        read_elements(str(path))
    path.write_text("R (mmHg s/mL)\n1\n0\n3\n")
    with pytest.raises(InputError, match="a resistance that is not positive"):
        read_elements(str(path))
    settings = FlowSettings(outlets="resistance", elements=3 * ((1e3, 0.0, 0.0),))
    with pytest.raises(InputError, match=r"3 rows for 2 outlets: give one for each outlet, the widest first"):
        ends_of(fork(), settings)
    with pytest.raises(InputError, match="have no effect with --outlets split: choose resistance or windkessel"):
        ends_of(fork(), replace(settings, outlets="split"))
