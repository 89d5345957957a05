"""The same figures on a GPU as on the CPU: operations, gradients, metrics, the network."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from ocnf_model import OctNetFusion, OctreeBatch
from ocnf_model.losses import bce_loss, l1_loss
from ocnf_model.metrics import mad_mm, tsdf_overlap
from ocnf_model.octree.resample import doubled
from ocnf_model.ops import OctreeConv3d, concat, grid_pool, grid_unpool, split_surface

pytestmark = pytest.mark.gpu
DEVICE = "cuda"


@pytest.fixture(autouse=True)
def _float32_in_full() -> Iterator[None]:
    if DEVICE == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    yield
    torch.backends.cuda.matmul.allow_tf32 = before


def agree(operation: Callable[[OctreeBatch], OctreeBatch | Tensor], x: OctreeBatch) -> None:
    """The operation's values, structure and gradient in its features are the same on both devices."""
    results, gradients = [], []
    for device in ("cpu", DEVICE):
        features = x.features.detach().to(device).requires_grad_()
        result = operation(OctreeBatch(x.structure, features))
        values = result if isinstance(result, Tensor) else result.features
        torch.manual_seed(1)
        gradients += torch.autograd.grad(values, features, torch.randn(values.shape).to(values))
        results.append(result)
        assert values.device.type == torch.device(device).type
    cpu, gpu = results
    if isinstance(cpu, OctreeBatch):
        assert (cpu.structure.trees == gpu.structure.trees).all()
        cpu, gpu = cpu.features, gpu.features
    torch.testing.assert_close(gpu.cpu(), cpu, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients[1].cpu(), gradients[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("likelihood", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("name", ["conv", "pool", "unpool", "guided", "split", "concat", "l1", "bce"])
def test_operations(make_batch, name: str, likelihood: float) -> None:
    x = make_batch(3, (4, 2, 6), 2, 5, likelihood, torch.float32)
    other = make_batch(4, (4, 2, 6), 2, 1, 0.5, torch.float32)
    finer = make_batch(5, (8, 4, 12), 2, 1, 0.5, torch.float32)
    torch.manual_seed(0)
    conv, head = OctreeConv3d(5, 7), torch.randn(5, 1)
    agree({
        "conv": lambda x: conv.to(x.device)(x),
        "pool": grid_pool,
        "unpool": grid_unpool,
        "guided": lambda x: grid_unpool(x, guide=finer.structure.union(doubled(x.structure))),
        "split": lambda x: split_surface(x, other.to(x.device), 1, guide=finer),
        "concat": lambda x: concat(x, x),
        "l1": lambda x: l1_loss(x.with_features(x.features @ head.to(x.device)), other.to(x.device), "none"),
        "bce": lambda x: bce_loss(x.with_features(x.features @ head.to(x.device)),
                                  other.with_features((other.features > 0).float()).to(x.device), "none"),
    }[name], x)


def test_gradients_of_weights(make_batch) -> None:
    x = make_batch(6, (2, 4, 2), 2, 6, 0.6, torch.float32)
    torch.manual_seed(0)
    conv = OctreeConv3d(6, 4)
    gradients = []
    for device in ("cpu", DEVICE):
        conv.zero_grad()  # before the move, which would take along the gradients kept below
        conv.to(device)
        conv(x.to(device)).features.square().sum().backward()
        gradients.append([parameter.grad.cpu() for parameter in conv.parameters()])
    for cpu, gpu in zip(*gradients, strict=True):
        torch.testing.assert_close(gpu, cpu, rtol=1e-4, atol=1e-3)


def test_metrics(make_batch) -> None:
    a, b = (make_batch(seed, (3, 2, 2), 3, 1, 0.5, torch.float32) for seed in (1, 2))
    torch.testing.assert_close(mad_mm(a.to(DEVICE), b.to(DEVICE), 0.1).cpu(), mad_mm(a, b, 0.1))
    torch.testing.assert_close(tsdf_overlap(a.to(DEVICE), b.to(DEVICE)).iou.cpu(), tsdf_overlap(a, b).iou)


@pytest.mark.parametrize("output", ["tsdf", "occupancy"])
def test_the_network(make_batch, output: str) -> None:
    inputs = [make_batch(level, (4 << level,) * 3, 2, 1, 0.3, torch.float32) for level in range(2)]
    torch.manual_seed(0)
    network = OctNetFusion("tsdf", 2, output=output, channels=(4, 6, 8)).eval()
    first, _ = network(inputs)
    gpu = network.to(DEVICE)([one.to(DEVICE) for one in inputs])
    torch.testing.assert_close(gpu[0].features.cpu(), first.features, rtol=1e-3, atol=1e-4)
    # Where the first level is within rounding of its threshold, the second may be split elsewhere.
    assert abs(gpu[1].n_leaves / network.cpu()(inputs)[1].n_leaves - 1) < 1e-3


def test_mixed_precision_and_checkpointing(make_batch) -> None:
    x = make_batch(7, (4, 4, 4), 2, 1, 0.3, torch.float32).to(DEVICE)
    torch.manual_seed(0)
    network = OctNetFusion("tsdf", 1, channels=(4, 6, 8)).to(DEVICE)
    full = network([x])[0].features
    with torch.autocast(DEVICE, torch.bfloat16):
        half = network([x])[0].features
    assert (half.float() - full).abs().mean() < 0.05 * full.abs().mean()
    gradients = []
    for checkpointing in (False, True):
        network.zero_grad()
        network.set_checkpointing(checkpointing)
        network([x])[0].features.square().sum().backward()
        gradients.append([parameter.grad.clone() for parameter in network.parameters()])
    for kept, again in zip(*gradients, strict=True):
        torch.testing.assert_close(again, kept, rtol=1e-3, atol=1e-3)
