"""What `ocnf-model info` prints: a network's layers, and how it was trained."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from torch import nn

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import TrainedRun, checkpoint_path, open_run, run_folder, trained_levels
from ocnf_model.header import Header
from ocnf_model.network import OctNetFusion
from ocnf_model.ops import OctreeConv3d

# Blocks that work below their level's resolution, and by how much.
_HALVINGS = {"down2": 1, "bottom": 2, "up2": 1, "context.down1": 3, "context.down2": 4,
             "context.up": 3, "context.out": 3}


def print_run(run: str | Path, console: Console) -> None:
    """Print layers, shapes and parameters of a run's network, and its training.

    Raises:
        OcnfError: there is no such run, or its checkpoints are damaged.
    """
    folder = run_folder(run)
    if not trained_levels(folder):
        from ocnf_model.training.record import SETTINGS, read_record

        if not (folder / SETTINGS).is_file():
            raise OcnfError("not a run", code="missing", where=folder,
                            expected=f"{checkpoint_path(folder, 1).name}, or {SETTINGS} of one begun")
        begun = read_record(folder)
        settings, data = begun.settings, begun.data
        console.print(f"{folder}: {settings.levels} levels to be trained on {data.name} ({data.n_train} "
                      "samples); no epoch is finished yet", highlight=False, markup=False)
        return
    trained = open_run(folder)
    console.print(layer_table(trained.network, trained.resolutions))
    console.print(training_table(trained))
    for line in _describe_training(trained.headers[-1]):
        console.print(line, highlight=False, markup=False)


def layer_table(network: OctNetFusion, resolutions: list[int]) -> Table:
    """A row a layer: name, resolution, channels, shape of the weight, parameters."""
    table = Table(title="layers", show_footer=True)
    n_parameters = sum(parameter.numel() for parameter in network.parameters())
    for title, footer in (("layer", "all"), ("voxels", ""), ("channels", ""), ("weight", ""),
                          ("parameters", f"{n_parameters:,}")):
        table.add_column(title, footer, justify="left" if title == "layer" else "right",
                         overflow="fold")
    level_before = "0"
    for name, module in network.named_modules():
        if not isinstance(module, OctreeConv3d | nn.Conv3d | nn.Linear):
            continue
        _, level, block = name.split(".", 2)
        if level != level_before:
            table.add_section()
            level_before = level
        out, into = module.weight.shape[:2]
        halvings = next((n for start, n in _HALVINGS.items() if block.startswith(start)), 0)
        resolution = resolutions[int(level)] >> halvings
        table.add_row(name, f"{resolution}³", f"{into} -> {out}", "x".join(map(str, module.weight.shape)),
                      f"{sum(parameter.numel() for parameter in module.parameters()):,}")
    return table


def training_table(trained: TrainedRun) -> Table:
    """A row a level: its best epoch and what was measured then; levels may have been measured otherwise."""
    measure = trained.headers[-1].settings.get("best_by", "mad")
    table = Table(title=f"best checkpoints, by {measure} of the validation samples")
    metrics = list(dict.fromkeys(name for header in trained.headers for name in header.metrics))
    for title in ("level", "resolution", "epoch", "steps", *metrics):
        table.add_column(title, justify="right", overflow="fold")
    for header in trained.headers:
        table.add_row(str(header.level), f"{header.resolution}³", str(header.epoch), str(header.steps),
                      *(f"{header.metrics[name]:.4g}" if name in header.metrics else "-"
                        for name in metrics))
    return table


def _describe_training(header: Header) -> list[str]:
    data, architecture = header.data, header.architecture
    variant = "" if data.variant is None else f", inputs {data.variant}"
    return [
        f"network: {architecture.encoding} -> {architecture.output}, join by {architecture.join}, carries "
        f"{architecture.carry}, band {architecture.band:g}",
        f"trained on {data.name}{variant}: {data.n_train} samples, {data.n_val} to validate; cube of "
        f"{data.extent:g} m, tau {data.truncation_voxels:.4g} voxels",
        f"data set {data.checksum[:16]}, PyTorch {header.torch}",
    ]
