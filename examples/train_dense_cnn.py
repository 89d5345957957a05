"""Train a dense 3-D CNN of your own on a data set: histograms of noisy views in, TSDF / tau out.

    python examples/train_dense_cnn.py OUT --resolution 64 --epochs 10

OUT is a data set that `ocnf-data generate` made; the network knows nothing of octrees.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from torch import nn
from torch.utils.data import DataLoader

from ocnf_data import ShardDataset
from ocnf_data.encodings import Encoding


def network(channels: int, width: int) -> nn.Module:
    """(B, channels, D, H, W) -> (B, 1, D, H, W) in [-1, 1]."""
    return nn.Sequential(
        nn.Conv3d(channels, width, 3, padding=1), nn.ReLU(),
        nn.Conv3d(width, width, 3, padding=1), nn.ReLU(),
        nn.Conv3d(width, 1, 3, padding=1), nn.Tanh())


def main(arguments: Sequence[str] | None = None) -> list[float]:
    """Train, and return the mean loss of each epoch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data")
    for name, default in (("--resolution", 64), ("--epochs", 10), ("--width", 16), ("--workers", 2)):
        parser.add_argument(name, type=int, default=default)
    options = parser.parse_args(arguments)

    torch.manual_seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    dataset = ShardDataset(options.data, "train", options.resolution, "histogram", batch_size=2)
    loader = DataLoader(dataset, batch_size=None, num_workers=options.workers)
    net = network(Encoding.HISTOGRAM.channels, options.width).to(device)
    optimiser = torch.optim.Adam(net.parameters(), 1e-2)
    history = []
    for epoch in range(options.epochs):
        losses = []
        for batch in loader:  # each pass over the loader is the next epoch
            inputs, targets = batch.to(device).dense(options.resolution)  # (2, 10, D, H, W), (2, 1, D, H, W)
            loss = (net(inputs) - targets).abs().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
        history.append(sum(losses) / len(losses))
        print(f"epoch {epoch}: L1 {history[-1]:.4f} tau", flush=True)
    return history


if __name__ == "__main__":
    main()
