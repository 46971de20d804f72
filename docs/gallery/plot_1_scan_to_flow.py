"""
From a scan to the flow before and after
========================================

From a scan to the blood flow in Python: every function takes data objects and returns a data object.
"""

# %%
# A synthetic scan of a curved artery with a sac stands for the patient's. ``vstent.read_vessel(folder)`` reads one and
# segments it.

import matplotlib.pyplot as plt
import numpy as np

import vstent
from vstent.phantoms import Scanner, demo_phantom, scan

phantom = demo_phantom()
image = scan(phantom, np.random.default_rng(1), scanner=Scanner(voxel_mm=0.5))
image.voxels.shape

# %%
# The lumen's wall, its openings and centerlines, cut to what matters.

vessel = vstent.trim(vstent.trace(vstent.segment(image)))
[(opening.role, round(opening.diameter_mm, 1)) for opening in vessel.openings]

# %%
# The parent artery without its sac. The phantom's truth is known, so that the result can be checked.

anatomy = vstent.restore(vessel)
sac = anatomy.aneurysms[0]
print(f"sac {sac.sac.volume_mm3:.0f} mm3, in truth {phantom.sac_volume_mm3:.0f} mm3")
assert abs(sac.sac.volume_mm3 / phantom.sac_volume_mm3 - 1) < 0.1

# %%
# A device in it. Its length in this artery is a prediction.

silk = vstent.deploy("silk", anatomy)
print(silk.advice)

stent, across, along = silk.stent, 1, 2  # the artery bends in the plane of y and z
figure, axes = plt.subplots(figsize=(6, 6))
for first, last in zip(stent.wire_starts[:-1], stent.wire_starts[1:], strict=True):
    wire_mm = stent.wire_points_mm[first:last]
    axes.plot(wire_mm[:, across], wire_mm[:, along], color="0.4", linewidth=0.4)
for line_mm, color, label in (
    (np.vstack([sac.neck_mm, sac.neck_mm[:1]]), "tab:red", "neck"),
    (anatomy.parent.axis.points_mm, "tab:blue", "axis of the parent artery"),
):
    axes.plot(line_mm[:, across], line_mm[:, along], color=color, label=label)
axes.plot(
    sac.sac.vertices_mm[:, across], sac.sac.vertices_mm[:, along], ".", color="tab:red", markersize=1, label="sac"
)
axes.set(xlabel="y, mm", ylabel="z, mm", aspect="equal")
axes.legend()

# %%
# The flow before and after, on cells far too coarse for a result (0.45 mm) but quick.

settings = vstent.FlowSettings(numerics=vstent.Numerics(cell_size_mm=0.45))
before, after = vstent.simulate(anatomy, [None, silk], settings)
change = vstent.compare(anatomy, before, after)["mean_sac_velocity_m_s"]
print(f"mean velocity in the sac, with over without the device: {change.ratio:.2f}")
assert 0.1 < change.ratio < 0.6
