"""One sample of a scan: all its frames -> ground truth, a random subset -> inputs, in the cube of meshes.

    scan -> frames -> cube -> [ground truth of all frames] , [configuration's frames -> inputs] -> bytes

A pure function of (manifest, scan, number of the configuration). The ground truth is the same for all
configurations of a scan; a process keeps that of the last few scans, which does not show in the samples.

A voxel that no frame of the scan counts is -tau in the ground truth, as everywhere (SEMANTICS 2): it is
unknown, and stands as if solid. As the inputs' frames are among those of the ground truth, no input counts it
either, and VolFus has the same -tau there. The share of the voxels that some frame does count stands in the
sample's facts as `observed`.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.fusion import DepthPyramid
from ocnf_data.generation.fingerprint import view_fingerprint
from ocnf_data.generation.inputs import Noise, SampleOctrees, as_target, fuse_input, noise_facts, real_metres
from ocnf_data.generation.procedural import scan_of_configuration
from ocnf_data.generation.records import Item, Sample, Stages
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.octree import GridOctree
from ocnf_data.sequences.cube import box_of_cube, into_cube, looks_into, object_box, placed
from ocnf_data.sequences.frames import FrameSequence
from ocnf_data.shards.tarformat import JSON, target_member
from ocnf_data.views.cameras import Views
from ocnf_data.views.normalisation import Normalisation
from ocnf_data.views.scans import Scan
from ocnf_data.views.store import KeptViews, ViewStore

_KNOWN_REFERENCES = 4
_FRAMES_TO_JUDGE = 10


@dataclass(frozen=True, eq=False)
class SequenceReference:
    """What all samples of a scan share.

    Attributes:
        normalisation: from the scan's coordinates to the cube.
        members: the ground truth's octrees, as they are stored, by member name.
        leaf_counts: number of leaves of each.
        facts: what the samples' facts say of the scan.
    """

    normalisation: Normalisation
    members: dict[str, bytes]
    leaf_counts: dict[str, int]
    facts: dict[str, Any]


_references: dict[tuple[str, str, str], SequenceReference] = {}


def make_sequence_sample(manifest: Manifest, source: SequenceSource, item: Item,
                         root: str | os.PathLike[str] | None, keep: ViewStore | None,
                         stages: Stages) -> Sample:
    """The sample of a configuration.

    Args:
        manifest: the manifest of the data set.
        source: its source.
        item: the configuration.
        root: the folder that the scans lie in.
        keep: store in which the configuration's frames are kept, in the cube; None: nowhere.
        stages: records each stage and its time.

    Raises:
        OcnfError: a frame that cannot be read, with the file's name; `changed` where the scan is not the one
            that was planned with; `invisible` where nothing was measured in the region.
    """
    if root is None:
        raise OcnfError("the folder of the scans is not given", code="missing", where=item.source)
    try:
        return _make(manifest, source, item, Path(root), keep, stages)
    except OcnfError as error:
        # Where the scans lie is no part of the data set: its bytes name them as the manifest does.
        raise error.replaced(where=_below(error.where, Path(root)) or item.source,
                             found=_below(error.found, Path(root))) from error


def _make(manifest: Manifest, source: SequenceSource, item: Item, root: Path, keep: ViewStore | None,
          stages: Stages) -> Sample:
    path = scan_of_configuration(item.source)
    with stages("read"):
        sequence = open_planned(source, item, root)
    reference = _reference(manifest, source, item, path, sequence, stages)
    indices = configuration(manifest, source, item, len(sequence))
    with stages("read"):
        views = placed(sequence.read(indices).views, reference.normalisation)
    if keep is not None:
        with stages("keep views"):
            keep.keep(item.key, KeptViews(views, item.sha256 or sequence.checksum(),
                                          view_fingerprint(manifest), reference.normalisation,
                                          manifest.normalise.extent))
    octrees = SampleOctrees(manifest, stages)
    octrees.members.update(reference.members)
    octrees.leaf_counts.update(reference.leaf_counts)
    noise = Noise(manifest.seed, item.key, views.size)
    for variant in manifest.inputs:
        first = indices[:variant.views]
        octrees.add_inputs(variant, views.subset(range(len(first))), first, noise,
                           real_metres(variant, item.source, reference.normalisation))
    facts = {**_item_facts(manifest, item), **reference.facts, "leaf_counts": octrees.leaf_counts,
             "inputs": {variant.name: {"views": list(indices[:variant.views]),
                                       "frames": [sequence.names[i] for i in indices[:variant.views]],
                                       **noise_facts(variant, real_metres(variant, item.source,
                                                                          reference.normalisation))}
                        for variant in manifest.inputs}}
    return Sample(item.key, {JSON: canonical_json(facts), **octrees.members}, stages.seconds)


def open_planned(source: SequenceSource, item: Item, root: Path) -> FrameSequence:
    """The frames of an item's scan.

    Raises:
        OcnfError: `changed` where they are not those that the item was planned with.
    """
    sequence = source.open(root, scan_of_configuration(item.source))
    found = sequence.checksum()
    if item.sha256 is not None and found != item.sha256:
        raise OcnfError("depth, poses or intrinsics have changed since the plan was made", code="changed",
                        where=item.source, found=f"sha256 {found}", expected=item.sha256)
    return sequence


def configuration(manifest: Manifest, source: SequenceSource, item: Item, n_frames: int) -> tuple[int, ...]:
    """The frames of an item, positions among all that are used; an input of k views sees the first k."""
    deal = source.deal(n_frames, scan_of_configuration(item.source), item.split, manifest.most_views,
                       manifest.seed)
    deal.check(1, False, item.source, item.split)
    return deal.subset(item.index or 0)


def _reference(manifest: Manifest, source: SequenceSource, item: Item, path: str, sequence: FrameSequence,
               stages: Stages) -> SequenceReference:
    """The ground truth of a scan, from memory where it was made before."""
    known = manifest.canonical_json(), path, item.sha256 or sequence.checksum()
    if known not in _references:
        made = _make_reference(manifest, source, path, sequence, stages)
        while len(_references) >= _KNOWN_REFERENCES:
            del _references[next(iter(_references))]
        _references[known] = made
    return _references[known]


def _make_reference(manifest: Manifest, source: SequenceSource, path: str, sequence: FrameSequence,
                    stages: Stages) -> SequenceReference:
    with stages("read"):
        scan = sequence.read()
    with stages("normalise"):
        normalisation, box = _place(manifest, source, path, scan)
        views, warnings = placed(scan.views, normalisation), scan.warnings
        del scan  # of 1,000 frames more than a gigabyte
    if not looks_into(views, manifest.normalise.extent):
        raise OcnfError("no frame has measured anything in the region", code="invisible", where=path,
                        field="source.region", found=" ".join(f"{x:.4g}" for x in box),
                        fix="check the region against the poses")
    with stages("pyramid"):
        pyramid = DepthPyramid(views)
    octrees, observed = SampleOctrees(manifest, stages), {}
    for resolution in manifest.resolutions:
        with stages("fuse target"):
            tsdf = fuse_input(manifest, pyramid, Encoding.TSDF, resolution)
            observed[str(resolution)] = observed_share(tsdf)
            truth = as_target(manifest, tsdf)
        octrees.add(target_member(resolution), truth, "target")
    facts = {
        "scan": {"path": path, "format": sequence.format, "frames": len(sequence), "box": list(box),
                 "warnings": list(warnings)},
        "normalisation": {"centre": normalisation.centre.tolist(), "scale": normalisation.scale,
                          "extent": manifest.normalise.extent},
        "camera": {"views": len(sequence), "K": views.K[0].tolist(), "size": list(views.size)},
        "coverage": float((views.depth > 0).mean()),
        "observed": observed,
    }
    return SequenceReference(normalisation, octrees.members, octrees.leaf_counts, facts)


def _place(manifest: Manifest, source: SequenceSource, path: str,
           scan: Scan) -> tuple[Normalisation, tuple[float, ...]]:
    """Where the region lies in the cube; and its box in the scan's coordinates."""
    region, padding = source.region_of(path), manifest.normalise.padding
    if region == "object":
        region = object_box(scan.views) if scan.cube is None else box_of_cube(scan.cube, padding)
    return into_cube(region, manifest.normalise.extent, padding), region


def observed_share(tsdf: GridOctree) -> float:
    """Share of the voxels that some view counts, 0 to 1: those that none counts are exactly -1."""
    counted = tsdf.data[:, 0] > -1
    return float((tsdf.leaf_sizes()[counted].astype(np.int64) ** 3).sum() / np.prod(tsdf.shape))


def _item_facts(manifest: Manifest, item: Item) -> dict[str, Any]:
    return {
        "key": item.key,
        "split": item.split,
        "category": item.category,
        "source": item.source,
        "sha256": item.sha256,
        "seed": manifest.seed,
        "target": str(manifest.target),
        "truncation": {str(res): manifest.truncation(res) for res in manifest.resolutions},
    }


def _below(text: str | None, root: Path) -> str | None:
    return None if text is None else text.replace(f"{root}{os.sep}", "")


def scan_notes(source: SequenceSource, root: Path) -> list[str]:
    """What is to be known of each scan before anything is made of it, a sentence each.

    That is which frames are left out, and what looks wrong with the poses, by a few neighbouring frames. A
    scan that cannot be read says nothing here: its items will fail, and say why.
    """
    found = []
    for scan in source.listed(root):
        with suppress(OcnfError):
            sequence = source.open(root, scan.path)
            if notes := sequence.listing.notes:
                more = f" (and {len(notes) - 1} more)" if len(notes) > 1 else ""
                found.append(f"{scan.path}: {notes[0]}{more}")
            start = max(0, (len(sequence) - _FRAMES_TO_JUDGE) // 2)
            some = range(start, min(start + _FRAMES_TO_JUDGE, len(sequence)))
            found += [f"{scan.path}: {warning}" for warning in sequence.read(some).warnings]
    return found


def placed_frames(source: SequenceSource, item: Item, root: Path, normalisation: Normalisation) -> Views:
    """All frames that an item's ground truth is made of, in the cube and in the order of time."""
    return placed(open_planned(source, item, root).read().views, normalisation)
