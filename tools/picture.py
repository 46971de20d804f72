"""Draw README's picture, the demo's flow before and after: ``python tools/picture.py [CASE]``.

CASE is a folder that ``vstent demo --out CASE`` has filled (``demo``, where ``make demo`` leaves it); what is missing
there is computed first.
"""

import json
import sys
from pathlib import Path

from vstent import study
from vstent.console import Console
from vstent.demo import write_scan
from vstent.report.figures import overview
from vstent.report.scene import scene_of
from vstent.study.provenance import RUN
from vstent.study.repeat import settings_of

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "demo.png"


def main(case: Path) -> None:
    """Go on with the demo in a case folder, and draw it."""
    settings = settings_of(json.loads((case / RUN).read_text())["settings"])
    result = study.run(write_scan(case / "scan"), case, settings, Console().progress)
    PICTURE.write_bytes(overview(scene_of(result)))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo"))
