"""A wider level computes what the narrow one did, and its copies learn apart."""

from __future__ import annotations

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model import OctNetFusion
from ocnf_model.network import reading_wider, widened

BEFORE = {"channels": (2, 3, 4), "encoding": "tdf_occupancy", "levels": 2}
WIDER = [(3, 3, 4), (2, 7, 4), (2, 3, 5), (5, 6, 16)]


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


def widen(narrow: OctNetFusion, widths: tuple[int, int, int], **settings) -> OctNetFusion:
    wide = OctNetFusion(**BEFORE | settings, first_channels=widths).double().eval()
    wide.levels[0].load_state_dict(widened(narrow.levels[0].state_dict(), narrow.channels, widths, seed=3))
    later = dict(narrow.levels[1].state_dict())
    if narrow.carry == "features":
        before = later["first.0.weight"]
        later["first.0.weight"] = reading_wider(before, narrow.channels[0], widths[0], seed=4)
    wide.levels[1].load_state_dict(later)
    return wide


@pytest.mark.parametrize("widths", WIDER)
@pytest.mark.parametrize("settings", [
    {}, {"join": "add"}, {"normalise": "batch"}, {"context": 16, "blend": True, "finer": 1},
    {"carry": "reconstruction"}, {"output": "occupancy"}], ids=str)
def test_both_levels_give_what_they_gave(settings, widths, inputs) -> None:
    torch.manual_seed(1)
    narrow = at_random(OctNetFusion(**BEFORE | settings))
    wide = widen(narrow, widths, **settings)
    assert wide.first_widths == widths and wide.channels == (2, 3, 4)
    with torch.no_grad():
        before, after = narrow.run(inputs), wide.run(inputs)
    assert [one.features.channels for one in after] == [widths[0], 2]
    for ours, theirs in zip(after, before, strict=True):
        scale = theirs.raw.features.abs().max()
        assert scale > 1e-6
        assert (ours.raw.features - theirs.raw.features).abs().max() < 1e-10 * scale


def test_copies_have_gradients_of_their_own(inputs) -> None:
    torch.manual_seed(2)
    wide = widen(at_random(OctNetFusion(**BEFORE)), (4, 6, 8)).requires_grad_()
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


@pytest.mark.parametrize("widths", [(16, 32), (0, 3, 4), (1, 2, 3, 4)])
def test_first_channels_are_three_positive_numbers(widths) -> None:
    with pytest.raises(OcnfError, match="first_channels: not channels"):
        OctNetFusion(first_channels=widths)
