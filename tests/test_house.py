"""The layout of the two packages: which folder may import which, how full the roots are, no name twice.

A *room* is a folder directly below a package, or a module at a package's root. Imports are read with `ast`,
so those inside functions and under TYPE_CHECKING count too. A new room, or a new arrow between two, is a row
or a word more in `ARROWS`; a new kind of room also a word in `FLOORS`.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("ocnf_data", "ocnf_model")
MOST_MODULES = 9

# Room: the rooms that it imports.
ARROWS = {
    "ocnf_data":
        "ocnf_data.errors ocnf_data.fusion ocnf_data.generation ocnf_data.loading ocnf_data.manifest "
        "ocnf_data.octree ocnf_data.render ocnf_data.synthesis ocnf_data.version ocnf_data.views",
    "ocnf_data.__main__": "ocnf_data.cli",
    "ocnf_data.arrays": "ocnf_data.errors",
    "ocnf_data.cli":
        "ocnf_data.doctor ocnf_data.encodings ocnf_data.export ocnf_data.generation ocnf_data.inspection "
        "ocnf_data.manifest ocnf_data.meshes ocnf_data.report ocnf_data.terminal ocnf_data.verify",
    "ocnf_data.doctor": "ocnf_data.arrays ocnf_data.errors ocnf_data.render ocnf_data.views",
    "ocnf_data.encodings": "",
    "ocnf_data.errors": "",
    "ocnf_data.export":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.manifest "
        "ocnf_data.meshes ocnf_data.octree ocnf_data.sequences ocnf_data.shards",
    "ocnf_data.files": "ocnf_data.errors",
    "ocnf_data.fusion":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.octree ocnf_data.views",
    "ocnf_data.generation":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.fusion "
        "ocnf_data.manifest ocnf_data.meshes ocnf_data.octree ocnf_data.render ocnf_data.scenes "
        "ocnf_data.sequences ocnf_data.shapes ocnf_data.shards ocnf_data.verify ocnf_data.version "
        "ocnf_data.views",
    "ocnf_data.inspection":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.generation "
        "ocnf_data.manifest ocnf_data.octree ocnf_data.render ocnf_data.sequences ocnf_data.shards "
        "ocnf_data.terminal ocnf_data.views",
    "ocnf_data.loading":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.octree "
        "ocnf_data.shards",
    "ocnf_data.manifest":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.meshes "
        "ocnf_data.scenes ocnf_data.sequences ocnf_data.shapes ocnf_data.views",
    "ocnf_data.meshes":
        "ocnf_data.arrays ocnf_data.errors ocnf_data.files ocnf_data.fusion ocnf_data.octree "
        "ocnf_data.render ocnf_data.views",
    "ocnf_data.octree": "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors",
    "ocnf_data.render":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.octree ocnf_data.views",
    "ocnf_data.report":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.generation "
        "ocnf_data.manifest ocnf_data.meshes ocnf_data.octree ocnf_data.render ocnf_data.sequences "
        "ocnf_data.shards ocnf_data.terminal ocnf_data.verify ocnf_data.views",
    "ocnf_data.scenes": "ocnf_data.arrays ocnf_data.errors ocnf_data.meshes ocnf_data.shapes",
    "ocnf_data.sequences":
        "ocnf_data.arrays ocnf_data.errors ocnf_data.files ocnf_data.fusion ocnf_data.octree "
        "ocnf_data.views",
    "ocnf_data.shapes": "ocnf_data.arrays ocnf_data.errors ocnf_data.meshes",
    "ocnf_data.shards":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.octree",
    "ocnf_data.synthesis":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.fusion "
        "ocnf_data.generation ocnf_data.loading ocnf_data.manifest ocnf_data.meshes ocnf_data.octree "
        "ocnf_data.render ocnf_data.scenes ocnf_data.shapes ocnf_data.shards ocnf_data.views",
    "ocnf_data.terminal": "ocnf_data.errors ocnf_data.files ocnf_data.version",
    "ocnf_data.verify": "ocnf_data.errors ocnf_data.files ocnf_data.octree ocnf_data.shards",
    "ocnf_data.version": "",
    "ocnf_data.views": "ocnf_data.arrays ocnf_data.errors ocnf_data.files",
    "ocnf_model": "ocnf_model.network ocnf_model.octree ocnf_model.ops ocnf_model.scan",
    "ocnf_model.baselines":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.octree ocnf_model.metrics",
    "ocnf_model.checkpoint":
        "ocnf_data.errors ocnf_data.files ocnf_model.devices ocnf_model.header ocnf_model.network "
        "ocnf_model.tensorfile",
    "ocnf_model.cli":
        "ocnf_data.terminal ocnf_model.completion ocnf_model.devices "
        "ocnf_model.evaluation ocnf_model.info ocnf_model.scan ocnf_model.tables ocnf_model.training",
    "ocnf_model.completion":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.fusion "
        "ocnf_data.loading ocnf_data.meshes ocnf_data.octree ocnf_data.render ocnf_data.scenes "
        "ocnf_data.sequences ocnf_data.terminal ocnf_data.views ocnf_model.checkpoint "
        "ocnf_model.devices ocnf_model.network ocnf_model.octree ocnf_model.training",
    "ocnf_model.devices": "ocnf_data.errors",
    "ocnf_model.evaluation":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.fusion "
        "ocnf_data.generation ocnf_data.loading ocnf_data.manifest ocnf_data.octree ocnf_data.render "
        "ocnf_data.report ocnf_data.shards ocnf_data.terminal ocnf_model.baselines "
        "ocnf_model.checkpoint ocnf_model.devices ocnf_model.measures ocnf_model.metrics "
        "ocnf_model.network ocnf_model.octree ocnf_model.ops",
    "ocnf_model.header":
        "ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_model.network "
        "ocnf_model.tensorfile",
    "ocnf_model.info":
        "ocnf_data.errors ocnf_model.checkpoint ocnf_model.header ocnf_model.network "
        "ocnf_model.ops ocnf_model.training",
    "ocnf_model.losses": "ocnf_data.errors ocnf_model.octree",
    "ocnf_model.measures":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.octree ocnf_data.views ocnf_model.losses "
        "ocnf_model.octree",
    "ocnf_model.metrics": "ocnf_data.octree ocnf_model.losses ocnf_model.octree",
    "ocnf_model.network":
        "ocnf_data.encodings ocnf_data.errors ocnf_model.devices ocnf_model.octree ocnf_model.ops",
    "ocnf_model.octree": "ocnf_data.arrays ocnf_data.errors ocnf_data.octree",
    "ocnf_model.ops":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.octree ocnf_model.octree",
    "ocnf_model.scan":
        "ocnf_data.arrays ocnf_data.errors ocnf_data.files ocnf_data.fusion ocnf_data.meshes "
        "ocnf_data.octree ocnf_data.render ocnf_data.sequences ocnf_data.views ocnf_model.baselines "
        "ocnf_model.checkpoint ocnf_model.devices ocnf_model.evaluation ocnf_model.header "
        "ocnf_model.network ocnf_model.octree",
    "ocnf_model.tables":
        "ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.fusion ocnf_data.generation "
        "ocnf_data.manifest ocnf_data.octree ocnf_data.shards ocnf_data.terminal ocnf_data.verify "
        "ocnf_data.views ocnf_model.checkpoint ocnf_model.completion ocnf_model.devices "
        "ocnf_model.evaluation ocnf_model.training",
    "ocnf_model.tensorfile": "ocnf_data.errors ocnf_data.files",
    "ocnf_model.training":
        "ocnf_data.arrays ocnf_data.encodings ocnf_data.errors ocnf_data.files ocnf_data.generation "
        "ocnf_data.loading ocnf_data.manifest ocnf_data.octree ocnf_data.render ocnf_data.shards "
        "ocnf_data.synthesis ocnf_model.checkpoint ocnf_model.devices ocnf_model.header "
        "ocnf_model.losses ocnf_model.measures ocnf_model.metrics ocnf_model.network "
        "ocnf_model.octree ocnf_model.ops ocnf_model.tensorfile",
}

# From the ground up: a room imports its own floor and those below it. Rooms not named are on `THE_REST`.
FLOORS = (
    ("ocnf_data.arrays", "ocnf_data.encodings", "ocnf_data.errors", "ocnf_data.version"),
    ("ocnf_data.octree", "ocnf_model.octree", "ocnf_data.files", "ocnf_data.terminal"),
    (),
    ("ocnf_data.generation", "ocnf_data.report", "ocnf_data.synthesis", "ocnf_model.training",
     "ocnf_model.completion", "ocnf_model.evaluation", "ocnf_model.scan"),
    ("ocnf_data.doctor", "ocnf_data.inspection", "ocnf_model.info", "ocnf_model.tables"),
    ("ocnf_data.cli", "ocnf_model.cli"),
    ("ocnf_data.__main__", "ocnf_data", "ocnf_model"),
)
THE_REST = 2

# What the network's package borrows, module by module.
BORROWED = """
    ocnf_data.arrays
    ocnf_data.encodings
    ocnf_data.errors
    ocnf_data.files.lock
    ocnf_data.files.memory
    ocnf_data.files.records
    ocnf_data.files.storage
    ocnf_data.files.storage_errors
    ocnf_data.files.strict_yaml
    ocnf_data.files.targets
    ocnf_data.files.validation
    ocnf_data.fusion
    ocnf_data.generation
    ocnf_data.generation.remake
    ocnf_data.loading.arguments
    ocnf_data.loading.augment
    ocnf_data.loading.catalogue
    ocnf_data.loading.dataset
    ocnf_data.loading.epochs
    ocnf_data.loading.mixture
    ocnf_data.loading.order
    ocnf_data.manifest
    ocnf_data.manifest.schema
    ocnf_data.meshes.decimate
    ocnf_data.meshes.writing
    ocnf_data.octree
    ocnf_data.octree.bits
    ocnf_data.octree.boxes
    ocnf_data.octree.surface
    ocnf_data.octree.symmetry
    ocnf_data.octree.triangles
    ocnf_data.render
    ocnf_data.render.pictures
    ocnf_data.render.shade
    ocnf_data.report.contents
    ocnf_data.report.page
    ocnf_data.report.sample
    ocnf_data.scenes
    ocnf_data.sequences.cube
    ocnf_data.shards
    ocnf_data.shards.browse
    ocnf_data.shards.catalogue
    ocnf_data.shards.dataset
    ocnf_data.shards.reader
    ocnf_data.shards.tarformat
    ocnf_data.synthesis.dataset
    ocnf_data.synthesis.sources
    ocnf_data.terminal
    ocnf_data.verify.summary
    ocnf_data.views.cameras
    ocnf_data.views.rigs
    ocnf_data.views.scans
    ocnf_data.views.scans.vertex_colour
    ocnf_data.views.sensor
    ocnf_data.views.trajectories
"""

# Public names that may be defined more than once, and why.
NAMESAKES = {
    "app": "each command line's typer application",
    "main": "each command line's entry point, named in pyproject.toml",
}


def modules() -> Iterator[tuple[str, Path]]:
    """(dotted name, file) of every module of both packages; a package goes by its own name."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


MODULES = dict(modules())


def imported(path: Path) -> set[str]:
    """The modules of the two packages that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] in PACKAGES}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: a relative import"
            if str(node.module).split(".")[0] in PACKAGES:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= inner & MODULES.keys()
                found |= {str(node.module)} if inner - MODULES.keys() else set()
    return found


def room(module: str) -> str:
    """`ocnf_data.generation` of `ocnf_data.generation.worker.pipe`."""
    return ".".join(module.split(".")[:2])


def arrows() -> dict[str, set[str]]:
    """The rooms that each room imports."""
    found: defaultdict[str, set[str]] = defaultdict(set)
    for module, path in MODULES.items():
        found[room(module)] |= {room(target) for target in imported(path)} - {room(module)}
    return dict(found)


def floor(name: str) -> int:
    return next((n for n, rooms in enumerate(FLOORS) if name in rooms), THE_REST)


def test_the_roots_are_not_drawers() -> None:
    for package in PACKAGES:
        assert len(list((ROOT / package).glob("*.py"))) <= MOST_MODULES, package


def test_rooms_import_what_the_table_says() -> None:
    assert arrows() == {name: set(targets.split()) for name, targets in ARROWS.items()}


def test_no_import_ring_between_rooms() -> None:
    order = list(TopologicalSorter(arrows()).static_order())  # raises CycleError, which names the ring
    assert order.index("ocnf_data.errors") < order.index("ocnf_data.octree") < order.index("ocnf_data.cli")


def test_no_arrow_points_up() -> None:
    upward = {(name, target) for name, targets in arrows().items() for target in targets
              if floor(target) > floor(name)}
    assert not upward


def test_the_data_package_never_imports_the_network() -> None:
    assert not {(name, target) for name, targets in arrows().items() for target in targets
                if name.startswith("ocnf_data") and target.startswith("ocnf_model")}


def test_the_network_borrows_these_modules_only() -> None:
    found = {target for module, path in MODULES.items() if module.startswith("ocnf_model")
             for target in imported(path) if target.startswith("ocnf_data")}
    assert found == set(BORROWED.split())


def test_no_public_name_is_defined_twice() -> None:
    homes: defaultdict[str, set[str]] = defaultdict(set)
    for module, path in MODULES.items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            match node:
                case ast.ClassDef(name=name) | ast.FunctionDef(name=name):
                    names = [name]
                case ast.Assign(targets=targets):
                    names = [target.id for target in targets if isinstance(target, ast.Name)]
                case ast.AnnAssign(target=ast.Name(id=name)):
                    names = [name]
                case _:
                    names = []
            for name in names:
                if not name.startswith("_"):
                    homes[name].add(module)
    twice = {name: sorted(found) for name, found in homes.items() if len(found) > 1}
    assert twice.keys() == NAMESAKES.keys(), twice


def test_no_kernel_takes_more_than_eight_parameters() -> None:
    kernels = {}
    for module, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(mark)
                                                         for mark in node.decorator_list):
                kernels[f"{module}.{node.name}"] = len(node.args.args)
    assert kernels["ocnf_data.fusion.cull.cull"] == 8
    assert not {name: n for name, n in kernels.items() if n > 8}
