"""Print what changes in the results of a flow when populations are stored in 16 bits and computed in 32.

Usage: python benchmarks/sixteen_bits.py [CASE ...]

Every population is encoded and decoded after each time step, so that the results are those of a 16-bit store. All
formats of a case start from the same flow and make the same number of time steps: a difference from 32 bits is due to
the format. Cases: demo-0.22 and demo-0.16 (Silk, steady), pulse (Silk, two cycles at 0.3 mm), nozzle (the FDA's nozzle,
Re 200 in the throat, 0.5 mm).

Formats (Lehmann, Krause, Amati, Sega, Harting and Gekle 2022, Phys. Rev. E 106, 015308, sec. III): FP16S is the IEEE
half precision of a population times 2^15, with 5 bits of exponent and 10 of mantissa. FP16C has 4 bits of exponent and
11 of mantissa. Rest weights are subtracted from the populations. "Shifted" also subtracts the mean density deviation of
the sac, so that small numbers are stored there.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.flow import sampling
from vstent.flow.case import PHASES, FlowCase, FlowField
from vstent.flow.engines import Outcome
from vstent.flow.indices import indices
from vstent.flow.lattice.engine import LatticeBoltzmann, PulsatileLatticeBoltzmann
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.reading import field_of, read
from vstent.flow.lattice.stepping import snapshot
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.geometry.vessel import Vessel

sys.path += [str(Path(__file__).parents[1] / "tests" / folder) for folder in ("flow", "helpers")]
SIGN, REST = np.uint32(0x8000), np.uint32(0x7FFF)


QUANTITIES = (
    "neck_inflow_mL_s",
    "mean_sac_velocity_m_s",
    "mean_sac_wss_Pa",
    "mean_sac_oscillatory_shear_fraction",
    "inlet_pressure_Pa",
)


class Format(NamedTuple):
    """A 16-bit format: a sign, an exponent and a mantissa."""

    dropped_bits: int
    """Bits of the mantissa of a float32 (23) that are not stored."""
    scale: float
    """Factor, a power of two, after which the exponents of a float32 fit: small numbers lose mantissa bits there."""


FP16S, FP16C = Format(13, 2.0**-97), Format(12, 2.0**-112)


@njit(forceinline=True)
def encode(value: Any, dropped_bits: Any, scale: Any) -> Any:
    """Return the 16 bits of a float32, rounded to nearest."""
    bits = np.float32(value * scale).view(np.uint32)
    bits += (np.uint32(1) << (dropped_bits - np.uint32(1))) - np.uint32(1) + ((bits >> dropped_bits) & np.uint32(1))
    return np.uint16(((bits >> np.uint32(16)) & SIGN) | ((bits >> dropped_bits) & REST))


@njit(forceinline=True)
def decode(stored: Any, dropped_bits: Any, inverse: Any) -> Any:
    """Return the float32 of 16 bits; `inverse` is 1 / scale."""
    bits = np.uint32(stored)
    widened = np.uint32(((bits & SIGN) << np.uint32(16)) | ((bits & REST) << dropped_bits))
    return widened.view(np.float32) * inverse


@njit
def rounded(f: Any, reference: Any, dropped_bits: Any, scale: Any) -> None:
    """Replace populations (19, n) float32 by what a 16-bit store of their distance from `reference` (19,) returns."""
    for q in range(len(f)):
        for i in range(f.shape[1]):
            bits = encode(f[q, i] - reference[q], dropped_bits, scale)
            f[q, i] = decode(bits, dropped_bits, np.float32(1) / scale) + reference[q]


@contextmanager
def stored(form: Format | None, density: float) -> Iterator[None]:
    """Store populations in a format between time steps, relative to a density deviation; None: in 32 bits."""
    update, reference = d3q19.update, (density * d3q19.WEIGHTS).astype(np.float32)

    def in_format(f: Any, cells: Any, links: Any, bands: Any, shares: Any) -> None:
        for k in range(2):
            one = slice(k, k + 1)
            update(f, (cells[0][one], *cells[1:]), (links[0][one], *links[1:]), bands, shares)
            by_direction = f[: -lanes.COUNT].reshape(19, -1)
            rounded(by_direction, reference, np.uint32(form.dropped_bits), np.float32(form.scale))

    d3q19.update = update if form is None else in_format
    try:
        yield
    finally:
        d3q19.update = update


class Judged(NamedTuple):
    """A case: engine, flow case, initial flow, number of checks, and its quantities."""

    engine: LatticeBoltzmann | PulsatileLatticeBoltzmann
    case: FlowCase
    start: FlowField | None
    checks: int
    quantities: Callable[[FlowField], dict[str, float]]


def computed(judged: Judged, form: Format | None, *, shifted: bool) -> dict[str, float]:
    """Return the quantities of a case in a format."""
    state = judged.engine.init(judged.case, judged.start)
    density = 0.0
    if shifted:
        density = float(snapshot(state).density[state.sac_cells].mean())
    with stored(form, density):
        while len(state.history) < judged.checks:
            judged.engine.step(state)
    outcome = Outcome(is_converged=True, residual=(0.0,) * judged.checks, seconds=0.0, loop_seconds=0.0)
    if judged.case.waveform is not None:
        return judged.quantities(judged.engine.result(state, outcome))
    return judged.quantities(field_of(state, read(state, [state.snapshots[-1]]), outcome, 0.0, ""))


def of_sac(case: FlowCase, field: FlowField) -> dict[str, float]:
    """Return the monitored quantities of the sac; the balance of the neck refers to its inflow."""
    found = indices(field, case.sac, case.ostium)
    balance = 1 - found["neck_outflow_mL_s"] / found["neck_inflow_mL_s"]
    return {name: found[name] for name in QUANTITIES if name in found} | {"neck balance": balance}


def demo(cell_mm: float, checks: int, *, pulse: bool = False) -> Judged:
    """Return the demo with Silk, from the converged flow at twice the spacing."""
    anatomy = restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.2)))))
    stent = vstent.deploy(vstent.find_design("silk"), anatomy).stent
    coarse = simulate_case(flow_case(anatomy, (stent,), FlowSettings(numerics=Numerics(cell_size_mm=2 * cell_mm))))
    settings = FlowSettings(waveform=OLDER_ADULT_ICA if pulse else None, numerics=Numerics(cell_size_mm=cell_mm))
    case = flow_case(anatomy, (stent,), settings)
    engine = PulsatileLatticeBoltzmann(cell_mm) if pulse else LatticeBoltzmann(cell_mm)
    return Judged(engine, case, coarse, checks, lambda field: of_sac(case, field))


def jet() -> Judged:
    """Return the nozzle at the flow and on the grid of the test of round jets."""
    from test_fda_nozzle import BLOOD, INFLOW_ML_S, nozzle

    settings = FlowSettings(
        blood=BLOOD, inflow_mL_s=0.4 * INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.5, lattice_speed=0.04)
    )
    return Judged(LatticeBoltzmann(0.5), vessel_case(nozzle(14.0), settings), None, 24, of_jet)


def of_jet(field: FlowField) -> dict[str, float]:
    """Return axial speeds on the axis and half a throat radius from it, and the pressure drop."""
    places = np.array([[x, 0.0, z] for z in (-20.0, 6.0, 12.0) for x in (0.0, 1.0)])
    speed_m_s = sampling.values_at(field, places)[0][:, 2]
    found = {f"speed at x {x:g}, z {z:g} mm": float(u) for (x, _, z), u in zip(places, speed_m_s, strict=True)}
    return found | {"inlet_pressure_Pa": float(field.pressure_Pa.max())}


CASES = {
    "demo-0.22": lambda: demo(0.22, 24),
    "demo-0.16": lambda: demo(0.16, 20),
    "pulse": lambda: demo(0.3, 2 * PHASES, pulse=True),
    "nozzle": jet,
}
FORMATS = {"32 bits": (None, False), "FP16S": (FP16S, False), "FP16C": (FP16C, False), "FP16C shifted": (FP16C, True)}


def main(names: list[str]) -> None:
    """Print a table for every case."""
    for name in names:
        judged = CASES[name]()
        found = {
            label: computed(judged, form, shifted=shifted)
            for label, (form, shifted) in FORMATS.items()
            if judged.case.sac is not None or not shifted
        }
        exact, *others = found.values()
        print(f"\n{name}:\n\n| quantity | {' | '.join(found)} |\n|{'---|' * (1 + len(found))}")
        for key, value in exact.items():
            cells = [f"{100 * (one[key] - value) / (1 if key == 'neck balance' else value):+.2f} %" for one in others]
            print(f"| {key} | {value:.4g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or list(CASES))
