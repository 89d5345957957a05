"""Draw samples of a data set: the mesh, its depth, the input and the ground truth with their octree cells.

python tools/show_sample.py demo-out                      one sample of each split
python tools/show_sample.py OUT --key chair_0007 --variant v4_n02 --encoding histogram
python tools/show_sample.py OUT --meshes ROOT --random 5 --pictures OUT/pictures
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.generation.remake import Remade, remake
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_data.render.pictures import busiest_plane, busiest_window, draw_depth, draw_slice
from ocnf_data.render.shade import shade
from ocnf_data.shards.browse import StoredSample, find_sample, stored_samples
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.shards.tarformat import input_member, target_member


def draw_sample(
    sample: StoredSample,
    manifest: Manifest,
    path: Path,
    meshes: Path | None = None,
    variant: str | None = None,
    encoding: Encoding | None = None,
    up: str = "z",
) -> None:
    """Draw one sample to `path`: an input variant in one encoding beside the ground truth."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    chosen = next((v for v in manifest.inputs if v.name == (variant or manifest.inputs[0].name)), None)
    if chosen is None:
        raise OcnfError("the data set has no such input", field="variant", found=variant,
                        expected=", ".join(v.name for v in manifest.inputs))
    encoding = encoding or chosen.encodings[0]
    coarse, fine = manifest.resolutions[0], manifest.resolutions[-1]
    inputs = {res: sample.octree(input_member(chosen.name, encoding, res)) for res in (coarse, fine)}
    targets = {res: sample.octree(target_member(res)) for res in (coarse, fine)}
    remade = remake(manifest, sample.facts, meshes)

    figure, axes = plt.subplots(2, 4, figsize=(16, 8.4), layout="constrained")
    _draw_inputs(axes[0], remade, chosen.name, manifest, up)
    extent = manifest.normalise.extent
    points, faces = octree_surface(targets[fine], extent, level=0.0 if manifest.target == "tsdf" else 0.5)
    axes[0, 3].imshow(shade(points, faces, size=640, up=up, frame=remade.vertices, colour=(0.62, 0.72, 0.82)))
    axes[0, 3].set_title(f"ground-truth surface, {fine}³")
    axes[0, 3].set_axis_off()
    plane = busiest_plane(targets[coarse], axis=1)
    kind = Encoding.OCCUPANCY if manifest.target == "occupancy" else Encoding.TSDF
    panels = [panel for res in (coarse, fine) for panel in (
        (inputs[res], encoding, res, f"input, {encoding}"), (targets[res], kind, res, "ground truth"))]
    for ax, (octree, shown_as, res, what) in zip(axes[1], panels, strict=True):
        at = plane * res // coarse
        window = busiest_window(targets[res], 1, at, width=2 * coarse) if res > 2 * coarse else None
        draw_slice(ax, octree, 1, at, shown_as, window)
        ax.set_title(f"{what}, {res}³, y = {at}\n{_leaves(octree)}", fontsize=11)
    legend = "slices: blue is free, white the surface, red inside or unseen; lines are the octree's cells"
    figure.suptitle(f"{sample.key}   ({sample.split}, {sample.facts['source']})\n{legend}", fontsize=12)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _draw_inputs(axes: Any, remade: Remade, variant: str, manifest: Manifest, up: str) -> None:
    """The mesh, one clean depth map, and the same with noise."""
    axes[0].imshow(shade(remade.vertices, remade.mesh.faces, size=640, up=up))
    axes[0].set_title(f"mesh, {len(remade.mesh.faces):,} faces")
    axes[0].set_axis_off()
    chosen = next(v for v in manifest.inputs if v.name == variant)
    view = manifest.view_indices(chosen)[0]
    clean, noisy = remade.views.depth[view], remade.observed[variant].depth[0]
    hit = clean[np.isfinite(clean) & (clean > 0)]
    limits = (float(hit.min()), float(hit.max())) if hit.size else (0.0, 1.0)
    draw_depth(axes[1], clean, limits)
    axes[1].set_title(f"clean depth, view {view}: {limits[0]:.2f} to {limits[1]:.2f} m")
    draw_depth(axes[2], noisy, limits)
    axes[2].set_title(f"noisy depth, sigma {chosen.sigma:g}" if chosen.noise == "park" else
                      f"noisy depth, {chosen.noise}, strength {chosen.strength:g}")


def _leaves(octree: GridOctree) -> str:
    return f"{octree.n_leaves:,} leaves, {octree.n_leaves / np.prod(octree.shape):.1%} of the voxels"


def pick(url: str, keys: list[str], n_random: int, seed: int) -> list[StoredSample]:
    """The samples to draw: those of `keys`, else `n_random` at random, else the first of each split."""
    if keys:
        return [find_sample(url, key) for key in keys]
    everything = list(stored_samples(url))
    if n_random:
        return random.Random(seed).sample(everything, min(n_random, len(everything)))
    return list({sample.split: sample for sample in reversed(everything)}.values())


def main(
    data: Annotated[str, typer.Argument(help="The data set: a folder or URL.")],
    key: Annotated[list[str] | None, typer.Option(help="Draw this sample; may be repeated.")] = None,
    random_: Annotated[int, typer.Option("--random", help="Draw this many samples at random.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the choice by --random.")] = 0,
    meshes: Annotated[Path | None, typer.Option(help="The folder that the meshes were read from.")] = None,
    variant: Annotated[str | None, typer.Option(help="Which input, default the first.")] = None,
    encoding: Annotated[Encoding | None, typer.Option(help="Which encoding, default its first.")] = None,
    up: Annotated[str, typer.Option(help="Which axis of the meshes points up: y or z.")] = "z",
    pictures: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("pictures"),
) -> None:
    """Draw samples of a data set as PNG."""
    try:
        manifest = Manifest.from_dict(load_dataset(data).manifest)
        for sample in pick(data, key or [], random_, seed):
            path = pictures / f"{sample.key}.png"
            draw_sample(sample, manifest, path, meshes, variant, encoding, up)
            typer.echo(path)
    except OcnfError as error:
        typer.secho(f"error: {error}", fg="red", err=True)
        raise typer.Exit(1) from None


if __name__ == "__main__":
    typer.run(main)
