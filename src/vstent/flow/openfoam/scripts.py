"""Shell scripts of an OpenFOAM case: run it here, run it on a cluster, clean it."""

from vstent.flow.openfoam.setup import FEATURES, FoamSetup

_DEBIAN = """\
# Debian's package has no bashrc to source; its programs only need the folder of their settings.
if [ -z "$WM_PROJECT_DIR" ] && [ -d /usr/share/openfoam/etc ]; then export WM_PROJECT_DIR=/usr/share/openfoam; fi
"""
"""Lines that set the environment of Debian's package."""


def all_run(setup: FoamSetup, application: str) -> str:
    """Return Allrun, which meshes once and then computes; run again, it resumes from the last time written."""
    features, solve = FEATURES[setup.flavour], application
    before = after = ""
    if setup.processes > 1:
        solve = f"mpirun -np {setup.processes} {application} -parallel"
        before = "[ -d processor0 ] || decomposePar > log.decomposePar 2>&1\n"
        after = "reconstructPar -latestTime > log.reconstructPar 2>&1\n"
    return f"""\
#!/bin/sh
set -e
cd "${{0%/*}}"
{_DEBIAN}\
if [ ! -f constant/polyMesh/owner ] || [ ! -f log.snappyHexMesh ]; then
    {features} > log.{features} 2>&1
    blockMesh > log.blockMesh 2>&1
    snappyHexMesh -overwrite > log.snappyHexMesh 2>&1
    checkMesh > log.checkMesh 2>&1
    renumberMesh -overwrite > log.renumberMesh 2>&1
fi
{before}{solve} >> log.{application} 2>&1
{after}"""


def slurm(setup: FoamSetup) -> str:
    """Return the Slurm script, which runs Allrun with the setup's number of processes."""
    return f"""\
#!/bin/sh
#SBATCH --job-name=vstent
#SBATCH --ntasks={setup.processes}
#SBATCH --time=04:00:00
#SBATCH --mem-per-cpu=2G
#SBATCH --output=slurm-%j.log
# Load your site's OpenFOAM here, for example: module load openfoam
# If the job runs out of time, submit it again: it resumes where it stopped.
./Allrun
"""


def all_clean() -> str:
    """Return Allclean, which restores the case as exported."""
    return """\
#!/bin/sh
cd "${0%/*}" || exit 1
rm -rf constant/polyMesh constant/extendedFeatureEdgeMesh constant/triSurface/*.eMesh constant/geometry/*.eMesh
rm -rf processor* postProcessing log.* [1-9]* 0.[0-9]*
"""
