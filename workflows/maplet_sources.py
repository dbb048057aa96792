"""Maplet catalogues of an archive: checked before a run, opened once per worker."""

from dataclasses import dataclass
from pathlib import Path

from fsspec.implementations.local import LocalFileSystem

from catalogs.archive import Archive, filesystem
from catalogs.maplets import MapletCatalogProblem, catalog_digest, open_catalog
from pipeline.errors import ConfigurationError
from pipeline.geometry.rays import RayTree, tree_of_mesh
from pipeline.geometry.shape import Shape
from pipeline.records import State, TriangleMesh
from pipeline.techniques.surface_features import MapletSource


@dataclass(frozen=True)
class MapletFolder:
    """One body's catalogue.

    Attributes
    ----------
    body
        Name, as in the State.
    path
        Its folder.
    sha256
        Digest of its index and of the names and sizes of its other files.
    """

    body: str
    path: Path
    sha256: str


def find_maplets(archive: Archive) -> tuple[MapletFolder, ...]:
    """Catalogues that an archive names.

    Parameters
    ----------
    archive
        The archive.

    Returns
    -------
    tuple of MapletFolder
        In the order of its description.

    Raises
    ------
    ConfigurationError
        If one is not there, or not on this machine's file system.
    """
    named = archive.description.maplets
    if not named:
        return ()
    system, root = filesystem(archive.url)
    if not isinstance(system, LocalFileSystem):
        raise ConfigurationError(f"{archive.url}: maplets: catalogues are read from local folders only")
    folders = []
    for body, entry in named.items():
        path = Path(root) / entry
        try:
            open_catalog(path)
            folders.append(MapletFolder(body, path, catalog_digest(path)))
        except MapletCatalogProblem as error:
            raise ConfigurationError(f"{archive.url}: maplets.{body}: {error}") from error
    return tuple(folders)


class Maplets:
    """Opened catalogues and the surfaces of their bodies, in one worker.

    Parameters
    ----------
    folders
        From the plan.
    """

    def __init__(self, folders: tuple[MapletFolder, ...]) -> None:
        self._catalogs = {folder.body.upper(): open_catalog(folder.path) for folder in folders}
        self._surfaces: dict[str, tuple[TriangleMesh, tuple[RayTree, float]]] = {}

    def sources(self, state: State) -> tuple[MapletSource, ...]:
        """Maplets of the bodies of an image.

        Parameters
        ----------
        state
            Its geometry.

        Returns
        -------
        tuple of MapletSource
            With a surface for occlusion where the State brings a mesh.
        """
        found = []
        for body in state.bodies:
            catalog = self._catalogs.get(body.name.upper())
            if catalog is not None:
                surface = None if body.mesh is None else self._surface(body.name, body.mesh)
                found.append(MapletSource(body.name, catalog.index, catalog.maplet, surface))
        return tuple(found)

    def _surface(self, name: str, mesh: TriangleMesh) -> tuple[RayTree, float]:
        known = self._surfaces.get(name)
        if known is None or known[0] is not mesh:
            known = (mesh, (tree_of_mesh(mesh), Shape(mesh).diameter_km))
            self._surfaces[name] = known
        return known[1]
