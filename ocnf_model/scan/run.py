"""`ocnf-model fuse`: read a scan, fuse it by one method or several, write what was asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.files.targets import check_target
from ocnf_data.fusion import DepthPyramid
from ocnf_data.views.scans import Scan, read_scan
from ocnf_model.checkpoint import open_run
from ocnf_model.devices import pick_device
from ocnf_model.evaluation.methods import Method, default_weight, parse_methods
from ocnf_model.scan.budget import check_voxel
from ocnf_model.scan.components import check_faces
from ocnf_model.scan.frames import limit_depth
from ocnf_model.scan.fuse import choose_region, reconstruct, refuse_both
from ocnf_model.scan.fusers import Baseline, Fuser, Learned
from ocnf_model.scan.outputs import (
    TSDF_SUFFIXES,
    check_dense,
    check_mesh,
    check_picture,
    check_placing,
    mesh_suffixes,
    refuse_same,
    save_tsdf,
)
from ocnf_model.scan.reconstruction import Reconstruction
from ocnf_model.scan.region import Region
from ocnf_model.scan.stages import StageLog
from ocnf_model.scan.tiles import tiled_shape

_ALIASES = {"network": "ours"}


@dataclass(frozen=True)
class Asked:
    """What `fuse` is asked for, beside the scan.

    Attributes:
        out: the mesh, .ply, .obj, .glb, .off or .stl; of several methods, NAME-METHOD.SUFFIX each. None: none
            is made, which needs a preview.
        run: a training run, or `pretrained`; read only where the network is among the methods.
        methods: `ours` or `network`, `volfus`, `tvl1`; a word may hold several, with commas.
        box: x0 y0 z0 x1 y1 z1 in metres, in the scan's coordinates. None: the cube that kept views were made
            for, else the largest fused object (`largest_object`).
        room: everything that the frames see, instead.
        voxel: metres; None: the region fits one cube.
        resolution: voxels along a cube; None: the network's finest, 256 for the baselines.
        max_depth: metres; what was measured beyond is not used.
        keep_unseen: keep the surfaces that close off what no camera has seen (see `observed`).
        keep_all: keep loose parts.
        faces: decimate each mesh to about so many.
        device: where the network runs: auto, cpu, cuda, ...
        weight: weight of TV-L1's data term, above 0; None: that of `DEFAULT_WEIGHTS`.
        tsdf: the TSDF, .npz or .oc; of several methods, NAME-METHOD.SUFFIX each.
        picture: a PNG of the methods' surfaces side by side.
        preview: a PNG of the region over the measured points and the cameras.
        reading: further arguments of `read_scan`.
    """

    out: Path | None
    run: str = "pretrained"
    methods: Sequence[str] = ("ours",)
    box: tuple[float, ...] | None = None
    room: bool = False
    voxel: float | None = None
    resolution: int | None = None
    max_depth: float | None = None
    keep_unseen: bool = False
    keep_all: bool = False
    faces: int | None = None
    device: str = "auto"
    weight: float | None = None
    tsdf: Path | None = None
    picture: Path | None = None
    preview: Path | None = None
    reading: Mapping[str, Any] = field(default_factory=dict)

    def chosen(self) -> tuple[Method, ...]:
        """The methods, each once."""
        names = [name.strip() for word in self.methods for name in word.split(",") if name.strip()]
        return parse_methods([_ALIASES.get(name, name) for name in names])

    def tagged(self, path: Path, method: str) -> Path:
        """The file of a method: several are told apart in its name."""
        return path.with_stem(f"{path.stem}-{method}") if len(self.chosen()) > 1 else path

    def check(self) -> None:
        """Raise OcnfError where something cannot be done whatever the scan is."""
        if self.out is None and self.preview is None:
            raise OcnfError("nothing to make", field="out", expected="--out MESH, or --preview PICTURE")
        if self.out is None and (self.tsdf is not None or self.picture is not None):
            raise OcnfError("nothing is fused without a mesh to write", field="out",
                            fix="name one with --out MESH")
        files = [path for path in (self.picture, self.preview) if path is not None]
        for path in files:
            check_picture(path)
        for method in self.chosen():
            for target, suffixes in ((self.out, mesh_suffixes()), (self.tsdf, TSDF_SUFFIXES)):
                if target is not None:
                    path = self.tagged(target, method)
                    check_target(path, suffixes)
                    files += [path, *check_placing(path)]
        refuse_same(files)
        if self.faces is not None:
            check_faces(self.faces)
        if not self.chosen():
            raise OcnfError("no method", field="method", expected="ours, volfus or tvl1")
        if self.weight is not None and Method.TVL1 not in self.chosen():
            raise OcnfError("it would have no effect: tvl1 is not among the methods", field="--weight",
                            found=self.weight, expected="no --weight")
        refuse_both(self.box, self.room)
        if self.voxel is not None:
            check_voxel(self.voxel)


def run_fuse(scan: str, asked: Asked, console: Console | None = None,
             began: float | None = None) -> list[Reconstruction]:
    """Fuse a scan, write the files, and say a line a stage.

    Args:
        scan: a scan in any format that `ocnf_data.views.scans` reads.
        asked: what is to be made, and how.
        console: where the lines are printed; None: on the standard output.
        began: `time.perf_counter()` when the command began.

    Returns:
        The surface by each method, in the order of `Method`.

    Raises:
        OcnfError: the scan, the region or the run cannot be used, or a file cannot be written. Then no mesh
            is.
    """
    stages = StageLog(console or Console(), began)
    region = None if asked.box is None else Region.of_box(asked.box)
    asked.check()
    with stages.stage("start") as stage:
        fusers = [_fuser(asked, method) for method in asked.chosen()]
        stage.say("; ".join(_described(fuser) for fuser in fusers))
    read = limit_depth(_read(scan, asked, stages), asked.max_depth)
    with stages.stage("region") as stage:
        pyramid = DepthPyramid(read.views)
        region = choose_region(read, pyramid, region, asked.room)
        lengths = " x ".join(f"{b - a:.3g}" for a, b in zip(region.low, region.high, strict=True))
        found = "the largest object" if read.cube is None else "the scan's own cube"
        what = "everything seen" if asked.room else "" if asked.box else found
        stage.say(", ".join(part for part in (what, str(region), f"{lengths} m") if part))
    for fuser in fusers:
        if asked.tsdf is not None:
            check_dense(asked.tsdf, _shape(region, asked.voxel, fuser.resolution))
        if asked.out is not None:
            check_mesh(asked.out, region, asked.voxel or region.size / fuser.resolution)
    if asked.preview is not None:  # before hours of fusing, so that it can be looked at
        from ocnf_model.scan.preview import draw_preview

        with stages.stage("preview") as stage:
            draw_preview(read, region, asked.preview)
            stage.say(str(asked.preview))
    results = []
    for fuser in fusers if asked.out is not None else ():
        results.append(reconstruct(read, pyramid, fuser, region, voxel=asked.voxel, stages=stages,
                                   keep_unseen=asked.keep_unseen, keep_all=asked.keep_all, faces=asked.faces))
    _write(asked, results, read, stages)
    return results


def _read(place: str, asked: Asked, stages: StageLog) -> Scan:
    with stages.stage("read") as stage:
        scan = read_scan(place, report=stage.report, **asked.reading)
        height, width = scan.views.size
        agree = "" if scan.agreement is None or len(scan.views) < 2 else f", {scan.agreement}"
        number = "1 frame" if len(scan.views) == 1 else f"{len(scan.views)} frames"
        stage.say(f"{number} of {width}x{height} ({scan.format}){agree}")
    stages.note(scan.notes)
    stages.note(scan.warnings, "Warning")  # before anything fails for the reason that they give
    return scan


def _write(asked: Asked, results: Sequence[Reconstruction], scan: Scan, stages: StageLog) -> None:
    """Write the files of all methods, and print a line for each and the time of all together."""
    if asked.out is None:
        return
    lines = []
    with stages.stage("write"):
        for result in results:
            path = asked.tagged(asked.out, result.method)
            result.save(path)
            voxels = f"{result.resolution}³" if asked.voxel is None else f"{1000 * asked.voxel:g} mm voxels"
            lines.append(f"{path}: {len(result.faces):,} faces by {Method(result.method).label} at {voxels}")
            if asked.tsdf is not None:
                save_tsdf(result, asked.tagged(asked.tsdf, result.method))
    if asked.picture is not None:
        from ocnf_model.scan.picture import draw_comparison

        with stages.stage("picture") as stage:
            draw_comparison(results, scan, asked.picture)
            stage.say(str(asked.picture))
    if stages.console is not None:
        lines[-1] += f", {stages.total:.1f} s in all, {results[-1].region}"
        for line in lines:
            stages.console.print(line, highlight=False, markup=False, soft_wrap=True)


def _shape(region: Region, voxel: float | None, resolution: int) -> tuple[int, int, int]:
    """Voxels (D, H, W) of the grid that will be fused, without going through the scan."""
    if voxel is None:
        return resolution, resolution, resolution
    return tiled_shape(region, max(voxel, 1e-9 * region.size))  # smaller ones are too many in any case


def _fuser(asked: Asked, method: Method) -> Fuser:
    if method is Method.OURS:
        trained = open_run(asked.run)
        trained.network.to(pick_device(asked.device))
        return Learned.of(trained, asked.resolution)
    resolution = 256 if asked.resolution is None else asked.resolution
    if method is Method.VOLFUS:
        return Baseline(resolution)
    return Baseline(resolution, default_weight(resolution) if asked.weight is None else asked.weight)


def _described(fuser: Fuser) -> str:
    if isinstance(fuser, Learned):
        device = next(fuser.network.parameters()).device
        return f"network up to {fuser.resolution}³ on {device}"
    return fuser.method.label if fuser.weight is None else f"{fuser.method.label} of weight {fuser.weight:g}"
