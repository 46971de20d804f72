"""What the two forks of OpenFOAM name differently; all other modules write the same for both."""

from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

from vstent.flow.openfoam.dictionary import foam_file

Flavour: TypeAlias = Literal["com", "org"]
"""openfoam.com (Debian's 1912 and later) or openfoam.org (11 and later)."""


@dataclass(frozen=True)
class Dialect:
    """Names and syntax of one fork."""

    is_org: bool
    """Whether it is openfoam.org's."""
    mark: str
    """A program found only in its current releases. Releases of openfoam.org before 11 use other settings."""
    features: str
    """Program that extracts sharp rims."""
    post_process: str
    """Program that runs function objects alone."""
    surfaces: str
    """Folder of the surfaces."""
    inside_point: str
    """Entry with the point inside the vessel."""
    taken_off: str
    """Action of topoSet that takes cells off a set."""
    models: str
    """File in constant/ of sources, such as porous zones."""
    porosity: str
    """Type of a porous zone in it."""

    @property
    def reads_geometry(self) -> bool:
        """Whether the case has an inlet's profile, and the neck on which the flow is sampled, as files."""
        return not self.is_org

    def application(self, *, is_steady: bool) -> dict[str, str]:
        """Return the entries that name the solver program."""
        if self.is_org:
            return {"application": "foamRun", "solver": "incompressibleFluid"}
        return {"application": "simpleFoam" if is_steady else "pimpleFoam"}

    def cycle(self, key: str, patch: str, table: str) -> tuple[dict[str, Any], dict[str, str]]:
        """Return the entry of a quantity that repeats a table, and the files in constant/ that it refers to."""
        if self.is_org:
            return {key: {"type": "table", "values": table, "outOfBounds": "repeat"}}, {}
        # Release 1912 accepts options next to a table only if the table is in a file.
        options = {"file": f'"<constant>/flow_{patch}"', "outOfBounds": "repeat"}
        return {key: "tableFile", f"{key}Coeffs": options}, {f"flow_{patch}": table + "\n"}

    def rims(self, surface: str) -> str:
        """Return the dictionary of the program `features` for one surface."""
        settings = {
            "includedAngle": 150,
            "geometricTestOnly": True,
            "subsetFeatures": {"nonManifoldEdges": False, "openEdges": True},
        }
        entries: dict[str, Any] = {surface: {"extractionMethod": "extractFromSurface", **settings, "writeObj": False}}
        if self.is_org:
            entries = {"surfaces": [f'"{surface}"'], **settings}
        return foam_file(f"{self.features}Dict", entries)

    def refined_inside(self, level: int) -> dict[str, Any]:
        """Return the refinement of the inside of a surface."""
        return {"mode": "inside", **({"level": level} if self.is_org else {"levels": [(1e15, level)]})}

    def fluid(self, nu: str, nu_at_rest: str, law: dict[str, str], note: str) -> dict[str, str]:
        """Return the fluid's files in constant/: its kinematic viscosity, and laminar flow.

        With other entries of the Carreau-Yasuda law, `nu` is the viscosity at high shear rate.
        """
        laminar: dict[str, Any] = {"simulationType": "laminar"}
        if self.is_org:
            if law:
                laminar["laminar"] = {"model": "generalisedNewtonian", "viscosityModel": "BirdCarreau", **law}
            constant = {"viscosityModel": "constant", "nu": nu_at_rest}
            return {
                "physicalProperties": foam_file("physicalProperties", constant, note=note),
                "momentumTransport": foam_file("momentumTransport", laminar),
            }
        transport: dict[str, Any] = {"transportModel": "Newtonian", "nu": f"nu {nu}"}
        if law:
            transport = {"transportModel": "BirdCarreau", "BirdCarreauCoeffs": {"nu0": nu_at_rest, **law}}
        return {
            "transportProperties": foam_file("transportProperties", transport, note=note),
            "turbulenceProperties": foam_file("turbulenceProperties", laminar),
        }


DIALECTS: Final[dict[Flavour, Dialect]] = {
    "org": Dialect(
        True,
        "foamRun",
        "surfaceFeatures",
        "foamPostProcess",
        "constant/geometry",
        "insidePoint",
        "delete",
        "fvModels",
        "porosityForce",
    ),
    "com": Dialect(
        False,
        "surfaceFeatureExtract",
        "surfaceFeatureExtract",
        "postProcess",
        "constant/triSurface",
        "locationInMesh",
        "subtract",
        "fvOptions",
        "explicitPorositySource",
    ),
}
