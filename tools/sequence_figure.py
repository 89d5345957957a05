"""A picture of a sample of a scan: an input frame, and the surfaces of each method beside the reference.

    python tools/sequence_figure.py DIR KEY --root SCANS [--run pretrained] [--variant v20] [--out FILE.png]

Everything is drawn from the camera of an input frame, at the finest resolution, and only where the reference
knows what is there. `--view N` takes another of the input's frames.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from ocnf_data.encodings import Encoding
from ocnf_data.generation.remake import remake
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_data.render.pictures import draw_depth
from ocnf_data.render.shade import shade_view
from ocnf_data.sequences.known import known_surface
from ocnf_data.shards.browse import find_sample
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.shards.tarformat import input_member, target_member
from ocnf_model.baselines import tvl1
from ocnf_model.checkpoint import open_run
from ocnf_model.evaluation.levels import run_levels
from ocnf_model.evaluation.methods import default_weight
from ocnf_model.octree.batch import OctreeBatch


def parse() -> argparse.Namespace:
    """The arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", metavar="DIR")
    parser.add_argument("key", metavar="KEY")
    parser.add_argument("--root", type=Path, required=True, metavar="SCANS")
    parser.add_argument("--run", default="pretrained")
    parser.add_argument("--variant", default="v20")
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--no-tvl1", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("pictures/sequence.png"))
    return parser.parse_args()


def main() -> None:
    """Draw."""
    options = parse()
    manifest = Manifest.from_dict(load_dataset(options.data).manifest)
    sample = find_sample(options.data, options.key)
    extent, finest = manifest.normalise.extent, manifest.resolutions[-1]
    views = remake(manifest, sample.facts, options.root).observed[options.variant]
    truth = sample.octree(target_member(finest))
    inputs = {res: sample.octree(input_member(options.variant, Encoding.HISTOGRAM, res))
              for res in manifest.resolutions}

    fields: dict[str, GridOctree] = {
        "VolFus": sample.octree(input_member(options.variant, Encoding.TSDF, finest))}
    if not options.no_tvl1:
        fields["TV-L1"] = tvl1(inputs[finest], default_weight(finest))
    network = open_run(options.run).network
    batches = [OctreeBatch.from_grids([octree]) for octree in inputs.values()]
    *_, last = run_levels(network, batches, torch.device("cpu"))
    output = last.reconstruction
    fields["network"] = output.with_features(output.features.clamp(-1, 1)).to_grids()[0]
    fields["reference: all frames"] = truth

    i = options.view
    figure = Figure(figsize=(4 * (1 + len(fields)), 3.4), layout="constrained")
    first, *others = figure.subplots(1, 1 + len(fields))
    depth = views.depth[i] / sample.facts["normalisation"]["scale"]
    hit = depth[depth > 0]
    draw_depth(first, depth, (float(np.percentile(hit, 1)), float(np.percentile(hit, 99))))
    first.set_title(f"one of {len(views)} input frames; red: no measurement", fontsize=10)
    for ax, (name, field) in zip(others, fields.items(), strict=True):
        vertices, faces = known_surface(field, extent, truth)
        ax.imshow(shade_view(vertices, faces, views.subset([i])))
        ax.set_title(name, fontsize=10)
        ax.set_axis_off()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
