"""Lattice units of the embedded engine, and the relaxation rate to which its accuracy and stability were tuned."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vstent.flow.settings import Blood
from vstent.units import M3_PER_ML

ODD_RATE = 0.7
"""Least relaxation rate of the odd (antisymmetric) part of the populations. A lower rate is more isotropic; a higher
rate is more stable and conserves mass better at the walls. In fast flow it is raised as far as stability requires
(`vstent.flow.lattice.kernels.collision`)."""
ODD_TIMES_EVEN = 0.1
"""Largest product of the relaxation times of odd and even populations, each less half a step. With 0.46, at a
relaxation time of one step, a row of wires four cells thick has 8 % too little drag; with 0.1 at most 2 %."""


def odd_rate(relaxation_steps: float) -> float:
    """Return the relaxation rate of the odd part for a relaxation time of the stress, in time steps."""
    return max(ODD_RATE, 1 / (0.5 + ODD_TIMES_EVEN / (relaxation_steps - 0.5)))


@dataclass(frozen=True)
class Scales:
    """Lattice units of one grid and time step."""

    cell_m: float
    """Grid spacing."""
    step_s: float
    """Time step."""
    blood: Blood
    """Density and viscosity."""
    odd_rate: float = ODD_RATE
    """Relaxation rate of the odd part of the populations; the same in all time steps of a run."""

    @property
    def speed_m_s(self) -> float:
        """Return the speed of one cell per time step."""
        return self.cell_m / self.step_s

    @property
    def pressure_Pa(self) -> float:
        """Return the pressure of a unit density deviation: rho c^2 / 3."""
        return self.blood.density_kg_m3 * self.speed_m_s**2 / 3

    @property
    def flow_mL_s(self) -> float:
        """Return the flow rate of one cell volume per time step."""
        return self.cell_m**3 / self.step_s / M3_PER_ML

    @property
    def viscosity(self) -> float:
        """Return the kinematic viscosity in squared cells per time step."""
        return self.blood.kinematic_viscosity_m2_s * self.step_s / self.cell_m**2

    @property
    def thinning(self) -> NDArray[np.float32]:
        """Return the Carreau-Yasuda law (4,) in lattice units (see `d3q19.update`); zeros for Newtonian blood."""
        law = self.blood.thinning
        if law is None:
            return np.zeros(4, np.float32)
        more = (law.rest_viscosity_Pa_s - self.blood.viscosity_Pa_s) / self.blood.viscosity_Pa_s
        return np.array([3 * self.viscosity * more, law.time_s / self.step_s, law.a, (law.n - 1) / law.a], np.float32)

    @property
    def relaxation_steps(self) -> float:
        """Return the relaxation time of the stress, in time steps."""
        return 3 * self.viscosity + 0.5
