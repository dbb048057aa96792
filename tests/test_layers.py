"""The order of imports, read from the source: nothing imports upward, equals do not import each other."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("pipeline", "catalogs", "workflows")
# Inside pipeline/, lowest first; a name stands for a module or a folder. A line is one level.
LEVELS = (
    ("status", "json_values"),
    ("errors", "options"),
    ("records",),
    ("camera",),
    ("geometry",),
    ("pose",),
    ("imaging",),
    ("frame",),
    ("predict",),
    ("techniques",),
    ("ensemble",),
    ("navigate",),
    ("curate",),
    ("tables", "pose_documents"),
)
# Within a folder: modules that the others of it may import, lowest first. All others are equals.
FOUNDATIONS = {
    "geometry": ("rotations", "shape", "rays", "maplet"),
    "imaging": ("psf", "illumination", "render", "ncc"),
    "pose": (
        "records", "schemas", "se3", "normalise", "refine", "pnp", "ransac", "graph",
        "estimator", "triangulation", "views", "bundle", "arc_landmarks", "arc_factors", "arcs",
    ),
    "predict": ("body_view", "bodies", "maplets"),
    "techniques": (
        "base", "star_fit", "star_match", "star_search", "star_inventory", "body_base", "body_search", "model_errors",
        "template_fit", "body_minor", "contour_fit", "limb_albedo", "lm", "line_search", "relief",
        "ring_image", "ring_units", "ring_unknowns", "ring_solve", "ring_texture", "ring_bands", "ring_pixels",
        "ring_fit", "ring_peaks", "ring_places", "ring_search", "ring_answer",
        "maplet_regression", "maplet_search", "maplet_correlation", "maplet_alignment", "landmark_table",
        "landmark_state",
    ),
}  # fmt: skip
OUTSIDE_OF_SCIENCE = {
    "catalogs", "workflows", "dask", "distributed", "spiceypy", "astropy", "erfa", "fsspec", "duckdb", "pandas", "yaml",
    "typer", "rich", "os", "pathlib", "time", "datetime", "io", "glob", "shutil", "tempfile", "subprocess", "random",
}  # fmt: skip
# Schemas are Arrow's, which is not a file.
ORDER_OF_CATALOGS = (
    "instruments", "label_text", "raw_images", "fits_images", "pds3_images", "gdal_images", "images", "labels",
    "bodies", "shapes", "terrain", "geometry", "ring_catalog", "header", "sidecar", "index_tables", "selection",
    "archive", "listing", "kernels", "spice", "star_sources", "stars", "spc_text", "spc_files", "maplets",
)  # fmt: skip


def modules(package: str) -> Iterator[tuple[str, Path]]:
    for path in sorted((ROOT / package).rglob("*.py")):
        yield ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), path


def imports(path: Path) -> set[str]:
    """Full names of all modules that a file imports, wherever in it; of ``from a import b`` a.b if that is a module."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports by a relative name"
            assert node.module is not None
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            modules_of = {name for name in inner if _is_module(name)}
            found |= modules_of or {node.module}
    return found


def _is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def _of(package: str) -> list[tuple[str, set[str]]]:
    return [(name, imports(path)) for name, path in modules(package)]


def _level(name: str) -> int:
    """Level of ``pipeline.x`` or ``pipeline.x.y``."""
    part = name.split(".")[1]
    return next(level for level, names in enumerate(LEVELS) if part in names)


def test_every_module_of_pipeline_has_a_level() -> None:
    known = {name for names in LEVELS for name in names}
    present = {name.split(".")[1] for name, _ in modules("pipeline") if "." in name}
    assert present <= known
    folders = {path.name for path in (ROOT / "pipeline").iterdir() if (path / "__init__.py").exists()}
    assert folders <= set(FOUNDATIONS)


@pytest.mark.parametrize(("name", "imported"), _of("pipeline"))
def test_science_reads_nothing(name: str, imported: set[str]) -> None:
    assert not {module.split(".")[0] for module in imported} & OUTSIDE_OF_SCIENCE, name


@pytest.mark.parametrize(("name", "imported"), _of("pipeline"))
def test_pipeline_imports_downward(name: str, imported: set[str]) -> None:
    ours = {module for module in imported if module.startswith("pipeline.")}
    if name == "pipeline":
        assert not ours
        return
    for module in ours:
        if name.split(".")[1] == module.split(".")[1] and "." in name.removeprefix("pipeline."):
            _check_within_folder(name, module)
        else:
            assert _level(module) < _level(name), f"{name} imports {module}"


def _check_within_folder(name: str, module: str) -> None:
    foundations = FOUNDATIONS[name.split(".")[1]]
    mine, its = name.split(".")[-1], module.split(".")[-1]
    assert its in foundations, f"{name} imports its equal {module}"
    if mine in foundations:
        assert foundations.index(its) < foundations.index(mine), f"{name} imports upward: {module}"


@pytest.mark.parametrize(("name", "imported"), _of("catalogs"))
def test_catalogs_know_no_workflow(name: str, imported: set[str]) -> None:
    assert not {module.split(".")[0] for module in imported} & {"workflows", "dask", "distributed"}, name
    own = name.split(".")[-1]
    for module in imported:
        if module.startswith("catalogs.") and own in ORDER_OF_CATALOGS:
            assert ORDER_OF_CATALOGS.index(module.split(".")[1]) < ORDER_OF_CATALOGS.index(own), (
                f"{name} imports {module}"
            )


@pytest.mark.parametrize(("name", "imported"), _of("workflows"))
def test_only_execution_knows_dask(name: str, imported: set[str]) -> None:
    if name != "workflows.execute":
        assert not {module.split(".")[0] for module in imported} & {"dask", "distributed"}, name


@pytest.mark.parametrize(("name", "imported"), [entry for entry in _of("workflows") if ".samples" in entry[0]])
def test_samples_share_nothing_with_the_navigator(name: str, imported: set[str]) -> None:
    ours = {module for module in imported if module.split(".")[0] in PACKAGES}
    assert all(module.startswith("workflows.samples") for module in ours), f"{name}: {ours}"


def _cycle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle, empty if none do."""
    left = {name: {m for m in imported if m in graph and m != name} for name, imported in graph.items()}
    while free := [name for name, imported in left.items() if not imported & set(left)]:
        for name in free:
            del left[name]
    return sorted(left)


def test_nothing_imports_in_a_circle() -> None:
    graph = {name: imported for package in PACKAGES for name, imported in _of(package)}
    assert _cycle(graph) == []


def test_the_checks_can_fail(tmp_path: Path) -> None:
    source = tmp_path / "bad.py"
    source.write_text(
        "import dask.array\nfrom pipeline import navigate\ndef f():\n    from workflows.plan import Plan\n"
    )
    assert imports(source) == {"dask.array", "pipeline.navigate", "workflows.plan"}
    assert _cycle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c", "d"]
    assert _level("pipeline.navigate") > _level("pipeline.techniques.base") > _level("pipeline.records")
    with pytest.raises(AssertionError, match="its equal"):
        _check_within_folder("pipeline.techniques.star_unique", "pipeline.techniques.star_field")
    with pytest.raises(AssertionError, match="upward"):
        _check_within_folder("pipeline.techniques.base", "pipeline.techniques.star_fit")
