"""Print how well measurements with calipers and three tubes determine every device of the catalogue.

Run from the repository: ``python benchmarks/device_fit.py [DRAWS]`` (200). The numbers of every specimen lie anywhere
in the ranges of its device. Lengths have a noise of 0.2 mm; the free diameter is measured at both ends with a noise of
0.05 mm; of laser-cut devices the angle of the cells is measured once with a noise of 1.5 degrees. The last column is
the share of specimens whose angle, free diameter and length lie in the stated 95 % interval.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from bench import draws, specimen

from vstent.devices.catalogue import catalogue


def fitted(count: int) -> None:
    print("| device and size | accepted | angle, deg rms | in 95 % | free diameter, mm rms | in 95 % | held by 95 % |")
    print("|---|---|---|---|---|---|---|")
    for design in catalogue().values():
        apart, stated = draws(design, count)
        rms, far = np.sqrt((apart**2).mean(axis=0)), np.quantile(np.abs(apart), 0.95, axis=0)
        held = (np.abs(apart) < 1.96 * stated).mean(axis=0)
        print(
            f"| {design.name} {specimen(design).label} | {len(apart)} | {np.degrees(rms[0]):.2f} | "
            f"{np.degrees(far[0]):.2f} | {rms[1]:.3f} | {far[1]:.3f} | "
            f"{' / '.join(f'{100 * one:.1f} %' for one in held)} |"
        )


if __name__ == "__main__":
    fitted(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
