"""Rebuild the JavaScript bundles from ``viewer/`` in a temporary folder and compare them with those in the package.

Run from the repository: ``python tools/viewer_check.py``. Where npm is not installed, nothing is compared.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("src/vstent/reporting/assets", "src/vstent/app/assets")
BUILT = (
    "src/vstent/reporting/assets/viewer.js",
    "src/vstent/reporting/assets/viewer.css",
    "src/vstent/reporting/assets/LICENSES.txt",
    "src/vstent/app/assets/app.js",
    "src/vstent/app/assets/app.css",
)
"""Files that ``npm run build`` writes."""


def rebuilt(folder: Path) -> list[str]:
    """Build the bundles in a copy of ``viewer/`` and return the names of those that differ from the repository's."""
    shutil.copytree(ROOT / "viewer", folder / "viewer", ignore=shutil.ignore_patterns("node_modules"))
    for assets in ASSETS:
        (folder / assets).mkdir(parents=True)
    for command in (["npm", "ci", "--silent", "--no-audit", "--no-fund"], ["npm", "run", "--silent", "build"]):
        subprocess.run(command, cwd=folder / "viewer", check=True)
    return [name for name in BUILT if (folder / name).read_bytes() != (ROOT / name).read_bytes()]


def main() -> int:
    """Compare; return 1 where a bundle differs."""
    if shutil.which("npm") is None:
        print("npm is not installed: the JavaScript bundles are not rebuilt")
        return 0
    with tempfile.TemporaryDirectory(prefix="vstent-viewer-") as folder:
        differing = rebuilt(Path(folder))
    if differing:
        print(f"These bundles differ from what viewer/ builds: {', '.join(differing)}. Run npm run build in viewer/.")
        return 1
    print(f"{len(BUILT)} built files are what viewer/ builds")
    return 0


if __name__ == "__main__":
    sys.exit(main())
