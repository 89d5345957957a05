"""What samples can be made of: mesh files of a split, and categories of procedural shapes and scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.generation.plan import check_splits, entry_source, list_items
from ocnf_data.generation.records import Item
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.mixture import MixtureSource, SourcePart
from ocnf_data.manifest.scenes import ScenesSource
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.manifest.shapes import ShapesSource
from ocnf_data.manifest.synthesis import Synthesis

_VERSION = "ocnf.synthesis.1"  # another one wherever the same draw would give another sample


@dataclass(frozen=True)
class Pool:
    """What one source gives: either mesh files, or procedural shapes or scenes.

    Attributes:
        weight: how often it is drawn from, relative to the others.
        items: mesh files of the source.
        categories: categories of the procedural shapes, or kinds of the scenes, of the source.
    """

    weight: float
    items: tuple[Item, ...] = ()
    categories: tuple[str, ...] = ()


@dataclass(frozen=True)
class Sources:
    """All that a split's samples can be made of.

    Attributes:
        manifest: the manifest, with its `synthesis` section filled in.
        meshes: the folder that the items' sources are relative to; None where nothing is read from files.
        split: name of the split.
        pools: the sources that have anything to draw.
        checksum: SHA-256 of everything that a sample of a given number depends on, the mesh files included.
    """

    manifest: Manifest
    meshes: str | None
    split: str
    pools: tuple[Pool, ...]
    checksum: str

    @property
    def settings(self) -> Synthesis:
        """The manifest's `synthesis` section."""
        assert self.manifest.synthesis is not None  # filled in
        return self.manifest.synthesis


def open_sources(manifest: Manifest, meshes: Path | None, split: str,
                 categories: tuple[str, ...] | None = None) -> Sources:
    """List the sources of a split and take the checksums of its mesh files.

    Args:
        manifest: a manifest; without a `synthesis` section the defaults hold.
        meshes: the folder that mesh paths are relative to; None for procedural shapes.
        split: `train`, `val` or `test`.
        categories: only these; None for all.

    Raises:
        OcnfError: there is no such split, the folder or a category is missing, or nothing is left to draw
            from (`empty`).
    """
    check_splits((split,), "split")
    source = manifest.source
    if isinstance(source, SequenceSource):
        raise OcnfError("samples without end are drawn of meshes, shapes and scenes, not of scans",
                        where=manifest.name, field="source.kind", found="sequence",
                        fix="make a data set of it with `ocnf-data generate`, and train on that")
    if meshes is not None and not meshes.is_dir():
        raise OcnfError("the folder of the meshes is not there", code="missing", where=meshes,
                        field="source.root", fix="give it as --meshes ROOT")
    if manifest.synthesis is None:
        manifest = manifest.model_copy(update={"synthesis": Synthesis()})
    assert manifest.synthesis is not None
    parts = source.parts if isinstance(source, MixtureSource) else (SourcePart(source=source),)
    items = {item.source: item for item in list_items(_each_once(manifest, split), meshes, (split,))[0]}
    pools = tuple(pool for pool in (_pool(part, items, meshes, manifest.seed, split, categories)
                                    for part in parts) if pool.items or pool.categories)
    found = {item.category for pool in pools for item in pool.items}
    found |= {name for pool in pools for name in pool.categories}
    if not pools or set(categories or ()) - found:
        raise OcnfError("there is nothing to draw samples from", code="empty", where=manifest.name,
                        field=f"source, split {split}",
                        found=None if categories is None else f"no {', '.join(set(categories) - found)}")
    return Sources(manifest, None if meshes is None else str(meshes), split, pools,
                   _checksum(manifest, split, pools))


def _each_once(manifest: Manifest, split: str) -> Manifest:
    """The manifest without procedural parts that share a category with an earlier one, as keys may not.

    What is drawn from them are no items: they may.
    """
    if not isinstance(manifest.source, MixtureSource):
        return manifest
    parts: list[SourcePart] = []
    seen: set[str] = set()
    for part in manifest.source.parts:
        if isinstance(part.source, ShapesSource | ScenesSource):
            names = set(part.source.names(split))
            if names & seen:
                continue
            seen |= names
        parts.append(part)
    return manifest.model_copy(update={"source": manifest.source.model_copy(update={"parts": tuple(parts)})})


def _pool(part: SourcePart, items: Mapping[str, Item], meshes: Path | None, seed: int, split: str,
          categories: tuple[str, ...] | None) -> Pool:
    def wanted(category: str) -> bool:
        return categories is None or category in categories

    if isinstance(part.source, ShapesSource | ScenesSource):
        return Pool(part.weight, categories=tuple(filter(wanted, part.source.names(split))))
    sources = [entry_source(entry) for entry in part.source.entries(meshes, seed)
               if entry.split == split and wanted(entry.category)]
    return Pool(part.weight, tuple(items[name] for name in sources if name in items))


def _checksum(manifest: Manifest, split: str, pools: tuple[Pool, ...]) -> str:
    fields = manifest.to_dict()
    decisive: dict[str, Any] = {name: fields[name] for name in (
        "seed", "normalise", "camera", "renderer", "truncation_voxels", "target")}
    assert manifest.synthesis is not None
    # Without defaults: a setting that a later version adds, at its default, changes nothing.
    decisive["synthesis"] = manifest.synthesis.model_dump(mode="json", exclude_defaults=True)
    if manifest.synthesis.misaligned != (0, 0):  # poses are off by shares of the finest voxel
        decisive["finest"] = max(manifest.resolutions)
    decisive["pools"] = [{"weight": pool.weight, "categories": list(pool.categories),
                          "items": [[item.source, item.sha256] for item in pool.items]} for pool in pools]
    return sha256_hex(canonical_json({"version": _VERSION, "split": split, **decisive}))
