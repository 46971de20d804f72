"""Draw README's picture, the demo's flow before and after: ``python tools/picture.py [CASE]``.

CASE is a folder that ``vstent demo --out CASE`` has filled (``demo``, where ``make demo`` leaves it); what is missing
there is computed first.
"""

import sys
from pathlib import Path

from vstent.cli.console import Console
from vstent.reporting.figures import Plate, Shot
from vstent.reporting.scene import scene_of
from vstent.study import pipeline as study
from vstent.study.folder import RUN
from vstent.study.repeat import read_record

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "demo.png"


def main(case: Path) -> None:
    """Go on with the demo in a case folder, and draw it."""
    record = read_record(case / RUN)
    result = study.run(record.input, record.folder, record.settings, Console().progress)
    scene = scene_of(result.anatomy, result.implants, result.fields)
    layers = ("lumen", "continued", "wires", "neck", "streamlines")
    shots = [Shot(title, scene.pick(layers, pane), scene.view("profile")) for pane, title in scene.panes]
    PICTURE.write_bytes(Plate("demo", "", "", scene, shots, "speed").drawn().png)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo"))
