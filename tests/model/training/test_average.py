"""The running average of the weights: its values, what is validated and kept, and resuming."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from ocnf_model.checkpoint import load_run
from ocnf_model.network import OctNetFusion
from ocnf_model.training.average import WeightAverage
from ocnf_model.training.run import train
from ocnf_model.training.train_state import load_state, save_state


@pytest.fixture
def module() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))


def test_the_average_is_the_weighted_sum_of_all_weights(module) -> None:
    decay, average, history = 0.7, WeightAverage(module, 0.7), [copy.deepcopy(module.state_dict())]
    for step in range(1, 31):
        for tensor in module.state_dict().values():
            tensor.copy_(torch.rand(tensor.shape) * 10)
        history.append(copy.deepcopy(module.state_dict()))
        average.update(step)
    kept = [min(decay, step / (step + 9)) for step in range(1, 31)]
    shares = torch.tensor([(1 - k) * torch.tensor(kept[i + 1:]).double().prod() for i, k in enumerate(kept)])
    for name, tensor in average.tensors.items():
        if not tensor.is_floating_point():
            assert torch.equal(tensor, history[-1][name])
            continue
        values = torch.stack([weights[name].double() for weights in history[1:]])
        first = history[0][name].double() * torch.tensor(kept).double().prod()
        expected = first + (shares.view(-1, *[1] * tensor.ndim) * values).sum(0)
        torch.testing.assert_close(tensor.double(), expected, rtol=1e-5, atol=1e-6)


def test_the_module_gets_its_own_weights_back(module) -> None:
    average = WeightAverage(module, 0.9)
    for parameter in module.parameters():
        parameter.data.add_(1)
    own = copy.deepcopy(module.state_dict())
    with pytest.raises(KeyError), average.in_use():
        assert all(torch.equal(t, average.tensors[name]) for name, t in module.state_dict().items())
        raise KeyError
    assert all(torch.equal(tensor, own[name]) for name, tensor in module.state_dict().items())


def test_the_checkpoint_is_the_average_and_resuming_changes_nothing(tiny, small, out, monkeypatch) -> None:
    settings = small(levels=1, average=0.6, loss="truncated_l1", normalise="batch", best_by="mad",
                     save_every=1,
                     stages=[{"epochs": 2, "batch_size": 2, "accumulate": 1, "learning_rate": 1e-2}])
    followed = []  # independent of the trainer: the average over all weights after steps of Adam
    step = torch.optim.Adam.step

    def noted(self, *args, **kwargs):
        result = step(self, *args, **kwargs)
        weights = [p.detach().clone() for group in self.param_groups for p in group["params"]]
        kept = min(0.6, (len(taken) + 1) / (len(taken) + 10))
        taken.append(None)
        followed[:] = [kept * a + (1 - kept) * w for a, w in zip(followed, weights, strict=True)]
        return result

    torch.manual_seed(settings.seed)
    taken: list[None] = []
    followed[:] = [p.detach().clone() for p in OctNetFusion(
        "tsdf", 1, channels=(2, 3, 4), normalise="batch").levels[0].parameters()]
    monkeypatch.setattr(torch.optim.Adam, "step", noted)
    train(tiny, out, settings, device="cpu")
    monkeypatch.undo()
    rows = load_state(out)[0].rows
    tensors = load_state(out)[1]
    names = [name for name, _ in OctNetFusion("tsdf", 1, channels=(2, 3, 4), normalise="batch")
             .levels[0].named_parameters()]
    for name, expected in zip(names, followed, strict=True):
        torch.testing.assert_close(tensors[f"average.{name}"], expected, rtol=1e-5, atol=1e-6)
        assert not torch.equal(tensors[f"average.{name}"], tensors[f"weights.{name}"])
    if rows[-1].best:
        kept = load_run(out).levels[0].state_dict()
        assert all(torch.equal(kept[name], tensors[f"average.{name}"]) for name in names)

    calls = []

    def stop(*arguments):
        save_state(*arguments)
        calls.append(None)
        if len(calls) == 4:
            raise KeyboardInterrupt

    again = out.parent / "again"
    monkeypatch.setattr("ocnf_model.training.stage.save_state", stop)
    with pytest.raises(KeyboardInterrupt):
        train(tiny, again, settings, device="cpu")
    monkeypatch.undo()
    train(tiny, again, settings, device="cpu")
    ours, theirs = load_run(out).state_dict(), load_run(again).state_dict()
    assert all(torch.equal(tensor, theirs[name]) for name, tensor in ours.items())
