"""One sample of a data set for the page: mesh, noisy input, plain fusion and ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.generation.remake import Remade, remake, remake_from_surface
from ocnf_data.manifest import Manifest, Variant
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.octree import GridOctree
from ocnf_data.render.pictures import busiest_plane, depth_limits, depth_scale
from ocnf_data.render.shade import best_azimuth, shade
from ocnf_data.report.contents import Card, Contents, Scale, as_webp, signed_surface
from ocnf_data.report.deviation import Deviation
from ocnf_data.report.geometry import Triangles, simplify
from ocnf_data.report.page import Column
from ocnf_data.shards.browse import StoredSample
from ocnf_data.shards.tarformat import input_member, target_member

THUMBNAIL = 200  # pixels
MESH, NOISY, VOLFUS, TRUTH_NAME = "Mesh", "Noisy input", "VolFus", "Ground truth"
_SCAN = "All frames"  # in the place of a mesh
_SLICED = 1  # planes of equal y
_VOXELS_OF_ERROR = 3  # at the end of the colour scale
_FUSED = (Encoding.TSDF, Encoding.HISTOGRAM, Encoding.TDF_OCCUPANCY, Encoding.OCCUPANCY)

COLUMNS = (Column("stored", "kB", 0), Column("mesh triangles", "", 0), Column("coverage", "% of pixels"),
           Column("ground truth", "% of voxels"), Column("input error", "mm"))


class Choice(NamedTuple):
    """What the page shows of each sample.

    Attributes:
        variant: the input.
        resolution: voxels along a side.
        triangles: the most of a surface.
        up: the axis that points up, y or z.
    """

    variant: Variant
    resolution: int
    triangles: int
    up: str


class Reconstructed(NamedTuple):
    """What a method made of the input.

    Attributes:
        name: what its button says.
        octree: 1 channel, or a histogram.
        encoding: of the octree.
        caption: a line below the name.
    """

    name: str
    octree: GridOctree
    encoding: Encoding
    caption: str = ""


class Picture(NamedTuple):
    """A sample as it is shown.

    Attributes:
        thumbnail: WebP.
        blob: what the 3-D view gets.
        errors: of each reconstruction, millimetres: the mean distance of its surface to the ground truth's;
            None where one of the two is empty.
        filled: share of the ground truth's leaves in its voxels, 0 to 1.
    """

    thumbnail: bytes
    blob: str
    errors: list[float | None]
    filled: float


def page_scale(manifest: Manifest, choice: Choice) -> Scale:
    """The scale of a data set's page."""
    extent = manifest.normalise.extent
    voxel = extent / choice.resolution
    return Scale(extent, voxel, _VOXELS_OF_ERROR * voxel, choice.triangles)


def make_card(sample: StoredSample, manifest: Manifest, choice: Choice, meshes: Path | None) -> Card:
    """The card of a data set's sample, with plain fusion as the one reconstruction.

    Raises:
        OcnfError: as `make_picture`.
    """
    picture = make_picture(sample, manifest, choice, meshes, [stored_fusion(sample, choice)])
    facts, entry = sample.facts, sample.entry
    triangles = facts["mesh"]["n_faces"] if "mesh" in facts else None  # a scan has no mesh
    values = [sum(member.size for member in entry.members) / 1e3, triangles,
              100 * facts["coverage"], 100 * picture.filled, picture.errors[0]]
    return Card(sample.key, sample.split, entry.category, entry.source,
                [None if value is None else float(value) for value in values],
                picture.thumbnail, picture.blob)


def stored_fusion(sample: StoredSample, choice: Choice) -> Reconstructed:
    """Plain fusion, from the encoding in the shard that is nearest to a TSDF."""
    fused = next(one for one in _FUSED if one in choice.variant.encodings)
    name, caption = {Encoding.TSDF: (VOLFUS, "the stored TSDF"),
                     Encoding.HISTOGRAM: (VOLFUS + "*", "the mean of the stored histogram"),
                     Encoding.TDF_OCCUPANCY: (VOLFUS + "*", "the stored distance with the occupancy's sign"),
                     Encoding.OCCUPANCY: ("Input occupancy", "as it is stored")}[fused]
    octree = sample.octree(input_member(choice.variant.name, fused, choice.resolution))
    return Reconstructed(name, octree, fused, f"{caption}, {choice.resolution}³")


def make_picture(sample: StoredSample, manifest: Manifest, choice: Choice, meshes: Path | None,
                 reconstructions: Sequence[Reconstructed], first: str | None = None) -> Picture:
    """A sample's mesh, input, reconstructions and ground truth, for the page.

    Where the mesh is not at hand, the surface of the ground truth stands in for it, and captions say so.

    Args:
        sample: the sample.
        manifest: of its data set.
        choice: what is shown.
        meshes: the folder of the meshes; None: where the manifest says, if they are there.
        reconstructions: in the order of their buttons.
        first: name of the surface that is shown when the sample is opened; None: the first.

    Raises:
        OcnfError: the sample is damaged; `meshes` is given and the mesh is not there or has changed.
    """
    kind = Encoding.TSDF if manifest.target == "tsdf" else Encoding.OCCUPANCY
    truth = sample.octree(target_member(choice.resolution))
    surface = _surface(sample, manifest, truth, kind)
    remade, is_mesh = _remade(sample, manifest, meshes, surface)
    contents = Contents(page_scale(manifest, choice), Deviation(surface))
    if isinstance(manifest.source, SequenceSource):
        contents.surface(_SCAN, Triangles(remade.vertices, remade.mesh.faces), "plain fusion of the scan",
                         compare=False)
    elif is_mesh:
        contents.surface(MESH, Triangles(remade.vertices, remade.mesh.faces), "as it was read and normalised",
                         flat=True, compare=False)
    add_views(contents, remade, choice.variant, sample.facts["inputs"][choice.variant.name], is_mesh)
    errors = [contents.surface(one.name, _surface(sample, manifest, one.octree, one.encoding), one.caption)
              for one in reconstructions]
    contents.surface(TRUTH_NAME, surface, f"{kind}, {choice.resolution}³", compare=False)
    add_slices(contents, [*reconstructions, Reconstructed(TRUTH_NAME, truth, kind)])
    small = simplify(Triangles(remade.vertices, remade.mesh.faces), 20_000)
    azimuth = best_azimuth(*small, choice.up)
    thumbnail = as_webp(shade(*small, THUMBNAIL, azimuth, up=choice.up, supersample=2))
    blob = contents.pack({"azimuth": azimuth, "frame": TRUTH_NAME, "depthColours": depth_scale(),
                          **({} if first is None else {"first": [first, TRUTH_NAME]})})
    return Picture(thumbnail, blob, errors, float(truth.n_leaves / np.prod(truth.shape)))


def add_views(contents: Contents, remade: Remade, variant: Variant, facts: Mapping[str, Any],
              is_mesh: bool) -> None:
    """Add the input's points, and its depth maps after the first one without noise.

    `facts` are the sample's of the input: its views, and of scans their frames' names.
    """
    indices, observed = facts["views"], remade.observed[variant.name]
    noise = variant.noise_in_words
    of_what = "" if is_mesh else ", of the ground truth's surface in place of the mesh"
    caption = f"{len(indices)} views, {noise}{of_what}"
    titles = [f"view {indices[0]} without noise", *(f"view {view}, {noise}" for view in indices)]
    if "frames" in facts:
        caption = f"{len(indices)} frames"
        titles = [f"{facts['frames'][0]}, as measured", *facts["frames"]]
    contents.points(NOISY, observed, caption)
    clean = remade.views.depth[list(indices)]
    limits = depth_limits(clean)
    for title, depth in zip(titles, [clean[0], *observed.depth], strict=True):
        contents.depth(title, depth, limits)


def add_slices(contents: Contents, reconstructions: Sequence[Reconstructed]) -> None:
    """Add the same plane of each octree: the one in which the last of them has most cells of one voxel."""
    last = reconstructions[-1].octree
    share_of_side = (busiest_plane(last, _SLICED) + 0.5) / last.shape[_SLICED]
    for one in reconstructions:
        n = one.octree.shape[_SLICED]
        plane, share = int(share_of_side * n), one.octree.n_leaves / np.prod(one.octree.shape)
        contents.slice(one.name, f"{n}³, y = {plane}: {one.octree.n_leaves:,} leaves, {share:.1%} of the "
                       "voxels", one.octree, _SLICED, plane, one.encoding)


def _surface(sample: StoredSample, manifest: Manifest, octree: GridOctree, encoding: Encoding) -> Triangles:
    """Of a scan without the walls around what no frame has seen, which would hide it."""
    partly = isinstance(manifest.source, SequenceSource) and manifest.target == "tsdf"
    known = sample.octree(target_member(octree.shape[0])) if partly else None
    return signed_surface(octree, encoding, manifest.normalise.extent, known)


def _remade(sample: StoredSample, manifest: Manifest, meshes: Path | None,
            surface: Triangles) -> tuple[Remade, bool]:
    """The sample made again, from its mesh or else from its ground truth; whether it was the mesh."""
    try:
        return remake(manifest, sample.facts, manifest.meshes_root(meshes)), True
    except OcnfError:
        if meshes is not None:
            raise
        return remake_from_surface(manifest, sample.facts, *surface), False
