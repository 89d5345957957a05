"""What is minimised: the loss by its name, and voxels that no view has measured counting less."""

from __future__ import annotations

import pytest
import torch

from ocnf_data import ShardDataset
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_model.losses import bce_loss, truncated_l1_loss
from ocnf_model.network import Output
from ocnf_model.training.batches import Example, make_example
from ocnf_model.training.objective import objective, voxel_weights
from ocnf_model.training.run import train


@pytest.fixture(scope="module", params=["tsdf", "tdf_occupancy"])
def example(request, tiny) -> tuple[Encoding, Example]:
    batch = next(iter(ShardDataset(tiny, "train", [32], request.param, batch_size=3, rank=0, world_size=1)))
    return Encoding(request.param), make_example(batch, Output.TSDF, "tsdf", torch.device("cpu"))


def test_what_no_view_has_measured_counts_less(example, small, dense) -> None:
    """With 0 the truth may be anything there; with a share, its part of the loss is that share."""
    encoding, sample = example
    given, target = dense.expand(sample.inputs[0]), sample.target
    unseen = given[:, :1] <= -1 if encoding is Encoding.TSDF else (given >= 1).all(1, keepdim=True)
    assert 0.02 < unseen.double().mean() < 0.9
    prediction = sample.inputs[0].with_features(torch.zeros(sample.inputs[0].structure.n_leaves, 1))
    costs = dense.expand(target).abs()
    for share in (0.0, 0.25):
        settings = small(encoding=encoding.value, unseen=share, loss="truncated_l1")
        weights = voxel_weights(settings, Output.TSDF, sample)
        found = objective(settings, Output.TSDF)(prediction, target, "mean", weights=weights)
        torch.testing.assert_close(found, (costs * torch.where(unseen, share, 1.0)).mean())


def test_the_paper_weighs_nothing(example, small) -> None:
    encoding, sample = example
    settings = small(encoding=encoding.value, loss="truncated_l1", wrong_sign=2.0)
    assert voxel_weights(settings, Output.TSDF, sample) is None
    loss = objective(settings, Output.TSDF)
    expected = truncated_l1_loss(sample.target, sample.target, wrong_sign=2.0)
    torch.testing.assert_close(loss(sample.target, sample.target), expected)
    assert objective(settings, Output.OCCUPANCY) is bce_loss
    assert voxel_weights(small(unseen=0.5), Output.OCCUPANCY, sample) is None


def test_training_minimises_it(tiny, small, tmp_path) -> None:
    """Two runs that differ in nothing but the weight end with other weights of the network, crops or not."""
    ends = []
    for crop in (None, 64):
        for share in (1.0, 0.0):
            stage = {"epochs": 1, "batch_size": 1, "accumulate": 1, "learning_rate": 1e-3}
            settings = small(unseen=share, stages=[stage, {**stage, "crop": crop}])
            network = train(tiny, tmp_path / f"{crop}-{share}", settings, device="cpu")
            ends.append(network.levels[1].head.weight.detach())
    assert (ends[0] - ends[1]).abs().max() > 1e-5
    assert (ends[2] - ends[3]).abs().max() > 1e-5


def test_an_encoding_that_does_not_tell_is_refused(small) -> None:
    with pytest.raises(OcnfError, match="does not tell what was measured"):
        small(encoding="occupancy", unseen=0.5)
