"""
How long a braid gets
=====================

Wires do not stretch, so a braid gets longer where the artery is narrower. In straight tubes the deployed length
follows the closed formula :math:`L(D)/L_0 = \\cos\\alpha(D)/\\cos\\alpha_0`.
"""

import matplotlib.pyplot as plt
import numpy as np

from vstent.devices.catalogue import catalogue, find_size
from vstent.devices.formulas import deployed_length_mm

widths_mm = np.linspace(2.6, 4.0, 40)
figure, axes = plt.subplots(figsize=(6, 4))
for key in ("silk", "pipeline", "lvis", "enterprise"):
    design = catalogue()[key]
    diameter_mm = 4.5 if key in ("lvis", "enterprise") else 4.0
    size = find_size(design, diameter_mm=diameter_mm)
    length_mm = [deployed_length_mm(design, size, width_mm) for width_mm in widths_mm]
    axes.plot(widths_mm, np.array(length_mm) / size.length_mm, label=f"{design.name} {size.label}")
axes.set(xlabel="diameter of the contour, mm", ylabel="deployed length over label length")
axes.legend()

# %%
# The narrower the artery, the longer the device: doubling is no exception for a dense braid that was chosen too wide.

silk = catalogue()["silk"]
size = find_size(silk, diameter_mm=4.0, length_mm=20)
print(f"Silk 4.0 x 20 mm at 2.6 mm: {deployed_length_mm(silk, size, 2.6):.1f} mm")
