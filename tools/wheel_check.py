"""Build the wheel, check its content, and run the demo from it with the lowest and the newest dependencies.

Run from the repository: ``python tools/wheel_check.py [--bounds] [PYTHON ...]``. With interpreters, the wheel is
installed in an empty environment of each. With ``--bounds`` it is installed twice, with the lowest versions that
``pyproject.toml`` declares and with the newest. Without either, it runs beside the packages of this environment.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CARRIED = (
    "vstent/py.typed",
    "vstent/devices/catalogue.toml",
    "vstent/reporting/assets/viewer.js",
    "vstent/reporting/assets/viewer.css",
    "vstent/reporting/assets/report.html.j2",
    "vstent/reporting/assets/LICENSES.txt",
)
"""Files without which an installed vstent does not work, or may not be handed on."""
RESULTS = ("report.html", "metrics.json", "run.json", "treatments/silk/implants/silk/wires.vtp")
"""Files that the demo leaves."""


def build(folder: Path) -> Path:
    """Build the wheel into a folder and see that it holds what the package holds, and nothing else."""
    quiet = ["--quiet", "--disable-pip-version-check"]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *quiet, "--no-deps", "-w", folder, ROOT], check=True)
    (wheel,) = folder.glob("vstent-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    missing = [name for name in CARRIED if name not in names]
    foreign = [name for name in names if not name.startswith("vstent")]
    if missing or foreign:
        raise SystemExit(f"{wheel.name} lacks {missing} and holds {foreign}")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, {len(names)} files")
    return wheel


COARSE_FLOW = ("--grid-spacing", "0.4", "--device", "silk")
"""Options of a demo with a flow that takes less than a minute."""


def demo(command: list[str], folder: Path, environment: dict[str, str], *options: str) -> None:
    """Run the demo far from the repository and check that its results exist; without options, without flow."""
    out = folder / "demo"
    given = ["demo", *(options or ("--no-flow",)), "--out", str(out)]
    done = subprocess.run([*command, *given], cwd=folder, env=environment, capture_output=True, text=True, check=False)
    missing = [name for name in RESULTS if not (out / name).is_file()]
    if done.returncode or missing:
        raise SystemExit(f"the demo ended with {done.returncode} and without {missing}:\n{done.stderr}")


def in_brief(wheel: Path, folder: Path) -> None:
    """Run the wheel's own files beside the packages of this environment."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    code = (
        "import sys, vstent, vstent.cli; assert 'site' in vstent.__file__, vstent.__file__; sys.exit(vstent.cli.main())"
    )
    demo([sys.executable, "-c", code], folder, os.environ | {"PYTHONPATH": str(folder / "site")})
    print("the demo without flow ran from the wheel")


def installed(wheel: Path, python: str, folder: Path) -> None:
    """Install the wheel into an empty environment of an interpreter and run it there."""
    version = subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    subprocess.run([python, "-m", "venv", folder / "empty"], check=True)
    binaries = folder / "empty" / "bin"
    quiet = ["--quiet", "--disable-pip-version-check"]
    subprocess.run([binaries / "python", "-m", "pip", "install", *quiet, wheel], check=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    demo([str(binaries / "vstent")], folder, environment)
    print(f"{version}: installed in an empty environment, and the demo without flow ran")


def lowest() -> list[str]:
    """Return the requirements of ``pyproject.toml`` and of the extra app, each at its lower bound."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["app"]]
    return [one.replace(">=", "==") for one in wanted]


def at_bounds(wheel: Path, python: str, folder: Path) -> None:
    """Run the demo with a coarse flow in two empty environments: with the lowest and with the newest dependencies."""
    for name, pinned in (("lowest", lowest()), ("newest", [])):
        place = folder / name
        subprocess.run([python, "-m", "venv", place / "env"], check=True)
        install = [place / "env" / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*install, f"{wheel}[app]", *pinned], check=True)
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        demo([str(place / "env" / "bin" / "vstent")], place, environment, *COARSE_FLOW)
        print(f"{name} dependencies: installed in an empty environment, and the demo with a coarse flow ran")


def main(words: list[str]) -> None:
    """Check the wheel with every interpreter given that is installed."""
    pythons = [word for word in words if word != "--bounds"]
    with tempfile.TemporaryDirectory(prefix="vstent-wheel-") as temporary:
        wheel = build(Path(temporary))
        if "--bounds" in words:
            at_bounds(wheel, (pythons or [sys.executable])[0], Path(temporary))
            return
        if not pythons:
            in_brief(wheel, Path(temporary))
        for number, python in enumerate(pythons):
            if (
                shutil.which(python) is None
                or subprocess.run([python, "-V"], capture_output=True, check=False).returncode
            ):
                print(f"{python}: not on this machine")
                continue
            folder = Path(temporary) / str(number)
            folder.mkdir()
            installed(wheel, python, folder)


if __name__ == "__main__":
    main(sys.argv[1:])
