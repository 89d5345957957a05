"""A wider level computes what the narrow one did, and its copies learn apart."""

from __future__ import annotations

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model import OctNetFusion
from ocnf_model.network import reading_wider, widened

BEFORE = {"channels": (2, 3, 4), "encoding": "tdf_occupancy", "levels": 2}
WIDER = [((3, 3, 4), (2, 3, 4)), ((2, 7, 4), (2, 3, 5)), ((2, 3, 5), (4, 3, 4)), ((5, 6, 16), (3, 5, 7))]


@pytest.fixture
def inputs(make_batch):
    """Two samples at 32^3 and 64^3, of different structures."""
    torch.manual_seed(0)
    return [make_batch(level, (4 << level,) * 3, 2, 2, 0.3, torch.float64) for level in range(2)]


def at_random(network: OctNetFusion) -> OctNetFusion:
    """No weight, bias or statistic as it is at first, where many are 0 or 1."""
    for name, tensor in network.state_dict().items():
        if tensor.is_floating_point():
            torch.nn.init.uniform_(tensor, *((0.5, 2) if "var" in name else (-0.5, 0.5)))
    return network.double().eval()


def widen(narrow: OctNetFusion, *widths: tuple[int, int, int], **settings) -> OctNetFusion:
    wide = OctNetFusion(**BEFORE | settings, level_channels=widths).double().eval()
    for level, own in enumerate(wide.levels):
        weights = widened(narrow.levels[level].state_dict(), narrow.channels, wide.widths(level), seed=3)
        if level and narrow.carry == "features":
            before = weights["first.0.weight"]
            weights["first.0.weight"] = reading_wider(before, narrow.channels[0], widths[0][0], seed=4)
        own.load_state_dict(weights)
    return wide


@pytest.mark.parametrize("widths", WIDER)
@pytest.mark.parametrize("settings", [
    {}, {"join": "add"}, {"normalise": "batch"}, {"context": 16, "blend": True, "finer": 1},
    {"carry": "reconstruction"}, {"output": "occupancy"}], ids=str)
def test_both_levels_give_what_they_gave(settings, widths, inputs) -> None:
    torch.manual_seed(1)
    narrow = at_random(OctNetFusion(**BEFORE | settings))
    wide = widen(narrow, *widths, **settings)
    assert (wide.widths(0), wide.widths(1)) == widths and wide.channels == (2, 3, 4)
    with torch.no_grad():
        before, after = narrow.run(inputs), wide.run(inputs)
    assert [one.features.channels for one in after] == [widths[0][0], widths[1][0]]
    for ours, theirs in zip(after, before, strict=True):
        scale = theirs.raw.features.abs().max()
        assert scale > 1e-6
        assert (ours.raw.features - theirs.raw.features).abs().max() < 1e-10 * scale


def test_copies_have_gradients_of_their_own(inputs) -> None:
    torch.manual_seed(2)
    wide = widen(at_random(OctNetFusion(**BEFORE)), (4, 6, 8), (2, 3, 4)).requires_grad_()
    wide.run(inputs)[1].raw.features.square().sum().backward()
    for name, width, copies in (("first.0", 2, 1), ("down1.0", 3, 2), ("bottom.1", 4, 2), ("up1.1", 2, 2)):
        weight = wide.get_submodule(f"levels.0.{name}").weight
        read = weight.unflatten(1, (copies, -1)).sum(1)  # of each old channel
        torch.testing.assert_close(read[:width], read[width:])
        first, copy = weight.grad[:width], weight.grad[width:]
        assert first.abs().max() > 0 and not torch.allclose(first, copy)


def test_the_parts_that_copies_are_read_with_are_neither_nothing_nor_all() -> None:
    weight = torch.rand(6, 5, 3, 3, 3) + 0.1
    wide = reading_wider(weight, 3, 8, seed=0)  # two inputs more, which stay
    torch.testing.assert_close(wide[:, 8:], weight[:, 3:])
    for channel in range(3):
        parts = wide[:, channel:8:3] / weight[:, channel:channel + 1]
        torch.testing.assert_close(parts.sum(1), torch.ones(6, 3, 3, 3))
        assert parts.min() > 0.2 / (0.2 + 2 * 0.8) - 1e-6
        assert parts.flatten(2).std(2).max() < 1e-6  # one for all of a kernel
    assert not torch.allclose(wide[:, 0], weight[:, 0] / 3)


@pytest.mark.parametrize("widths", [(16, 32), (0, 3, 4), (1, 2, 3, 4), (4.0, 6, 8), 4, "123", None])
def test_the_channels_of_a_level_are_three_positive_numbers(widths) -> None:
    with pytest.raises(OcnfError, match="level_channels: not channels"):
        OctNetFusion(level_channels=[(1, 1, 1), widths])


def test_levels_without_channels_of_their_own_have_everyones() -> None:
    network = OctNetFusion(channels=(2, 2, 2), level_channels=[(3, 2, 1), (2, 4, 3)], levels=4)
    assert [network.widths(level) for level in range(4)] == [(3, 2, 1), (2, 4, 3), (2, 2, 2), (2, 2, 2)]
    assert [level.bottom[0].weight.shape[0] for level in network.levels] == [1, 3, 2, 2]
    with pytest.raises(OcnfError, match="level_channels: no channels"):
        OctNetFusion(level_channels=[])
