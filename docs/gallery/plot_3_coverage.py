"""
Metal over the neck
===================

How much of the wall a device covers depends on the diameter that it opens to. The formula of the flat rhombic braid,
:math:`1 - (1 - d/s)^2`, against the diameter.
"""

import matplotlib.pyplot as plt
import numpy as np

from vstent.devices.catalogue import catalogue, find_size
from vstent.devices.formulas import coverage_fraction, pore_density_per_mm2

widths_mm = np.linspace(2.6, 4.0, 40)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
for key in ("silk", "pipeline", "surpass_evolve"):
    design = catalogue()[key]
    size = find_size(design, diameter_mm=4.0)
    left.plot(widths_mm, [coverage_fraction(design, size, width_mm) for width_mm in widths_mm], label=design.name)
    right.plot(widths_mm, [pore_density_per_mm2(design, size, width_mm) for width_mm in widths_mm])
left.set(xlabel="diameter, mm", ylabel="part of the wall under metal")
right.set(xlabel="diameter, mm", ylabel="pores per mm2")
left.legend()
figure.tight_layout()
