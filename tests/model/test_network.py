"""The network: its size by hand, its equality with a dense one, training stage by stage."""

from __future__ import annotations

import copy
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool3d, batch_norm, conv3d, interpolate, linear, max_pool3d

import ocnf_model
from ocnf_data import Views
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import fuse
from ocnf_data.octree import GridOctree
from ocnf_model import OctNetFusion, OctreeBatch
from ocnf_model.info import layer_table
from ocnf_model.losses import bce_loss, l1_loss
from ocnf_model.network.finer import guessed_encoding, pooled_encoding
from ocnf_model.ops import grid_pool

SMALL = {"encoding": "tsdf", "channels": (2, 3, 4)}


@pytest.fixture
def inputs(make_batch) -> list[OctreeBatch]:
    """Two samples at 32^3 and 64^3, of different structures."""
    torch.manual_seed(0)
    return [make_batch(level, (4 << level,) * 3, 2, 1, 0.3, torch.float32) for level in range(2)]


@pytest.mark.parametrize(("settings", "first", "later"), [
    # first + down1 + down2 + bottom + up2 + up1 + head, all 27 in out + out
    ({}, 4336 + 13856 + 83040 + 331968 + 138304 + 34592 + 17, 6912),
    ({"join": "add"}, 4336 + 13856 + 83040 + 331968 + 83008 + 20768 + 17, 6912),
    ({"carry": "reconstruction", "output": "occupancy"}, 606113 - 17 + 433, 432),
    ({"encoding": "tdf_occupancy"}, 606113 - 8 * 432, 6912),
    ({"finer": 3}, 606113 + 10 * 432, 6912),
])
def test_number_of_parameters(settings, first, later) -> None:
    network = OctNetFusion(**settings)
    counts = [sum(p.numel() for p in level.parameters()) for level in network.levels]
    assert counts == [first, first + later, first + later]
    table = layer_table(network, [64, 128, 256])
    assert table.columns[-1].footer == f"{sum(counts):,}"
    assert sum(int(str(cell).replace(",", "")) for cell in table.columns[-1].cells) == sum(counts)


def dense_context(context, x: torch.Tensor) -> torch.Tensor:
    """What `DenseContext` adds, layer by layer."""
    half = context.down1(avg_pool3d(x, 2))
    quarter = interpolate(context.down2(avg_pool3d(half, 2)), scale_factor=2, mode="trilinear")
    joined = context.up(torch.cat([quarter, half], 1))
    return interpolate(context.out(joined), scale_factor=2, mode="trilinear")


def dense_level(level, x: torch.Tensor, column: int = -1) -> tuple[torch.Tensor, torch.Tensor]:
    """A level on (B, C, D, H, W) volumes, with torch's own operations; a TSDF is encoded in `column`."""
    def run(convs, x):
        for conv in convs:
            y = conv3d(x, conv.weight, conv.bias, padding=1)
            if level.normalise == "batch":
                norm = conv.norm
                y = batch_norm(y, norm.running_mean, norm.running_var, norm.weight, norm.bias)
            y = y.relu()
            x = y + x if level.residual and y.shape == x.shape else y
        return x

    def join(coarse, skipped):
        up = interpolate(coarse, scale_factor=2, mode="nearest")
        return torch.cat([up, skipped], 1) if level.join == "concat" else up + skipped

    fine = run(level.down1, run(level.first, x))
    middle = run(level.down2, max_pool3d(fine, 2))
    deep = max_pool3d(middle, 2)
    if level.context is not None:
        deep = deep + dense_context(level.context, deep)
    deep = run(level.bottom, deep)
    features = run(level.up1, join(run(level.up2, join(deep, middle)), fine))
    if level.output == "occupancy":
        return features, conv3d(features, level.head.weight, level.head.bias, padding=1)
    raw = linear(features.movedim(1, -1), level.head.weight, level.head.bias).movedim(-1, 1)
    if level.blend is not None:
        gate = level.blend.gate
        share = (16 * linear(features.movedim(1, -1), gate.weight, gate.bias)).movedim(-1, 1).sigmoid()
        raw = share * x[:, column][:, None] + (1 - share) * raw.clamp(-1.25, 1.25)
    return features, raw


@pytest.mark.parametrize("settings", [
    {"join": "concat", "carry": "features", "output": "tsdf"},
    {"join": "add", "carry": "reconstruction", "output": "occupancy"},
    {"context": 16, "residual": True},
    {"normalise": "batch", "context": 16},
    {"blend": True},
    {"blend": True, "carry": "reconstruction"},
])
def test_where_every_leaf_is_a_voxel_it_is_the_dense_network(settings) -> None:
    torch.manual_seed(1)
    network = OctNetFusion(**SMALL, levels=2, **settings).double()
    for tensor in (*network.parameters(), *network.buffers()):  # the context's last layer begins at zero
        if tensor.is_floating_point():
            tensor.data += 0.1 * torch.rand_like(tensor)
    network.eval()
    volumes = [torch.randn(1, 1, n, n, n).double() for n in (32, 64)]
    outputs = network.run([OctreeBatch.full(volume) for volume in volumes])
    features, raw = dense_level(network.levels[0], volumes[0])
    torch.testing.assert_close(outputs[0].raw.to_dense(), raw)
    reconstruction = raw.sigmoid() if settings.get("output") == "occupancy" else raw
    carried = reconstruction if settings.get("carry") == "reconstruction" else features
    carried = interpolate(carried, scale_factor=2, mode="nearest")
    _, raw = dense_level(network.levels[1], torch.cat([carried, volumes[1]], 1))
    torch.testing.assert_close(outputs[1].raw.to_dense(), raw)


@pytest.mark.parametrize("output", ["tsdf", "occupancy"])
def test_a_stage_trains_its_own_level_only(output, inputs) -> None:
    network = OctNetFusion(**SMALL, levels=2, output=output)
    loss = l1_loss if output == "tsdf" else bce_loss
    target = inputs[1].with_features(inputs[1].features.sigmoid())
    result = network.run(inputs, frozen=1)[-1]
    loss(result.raw, target).backward()
    assert all(p.grad is None for p in network.levels[0].parameters())
    assert all(p.grad is not None and p.grad.any() for p in network.levels[1].parameters() if p.ndim > 1)
    assert torch.equal(result.reconstruction.features, network(inputs)[1].features)


@pytest.mark.parametrize("settings", [{"finer": 1}, {"finer": 2, "blend": True},
                                      {"finer": 2, "carry": "reconstruction"}])
def test_what_is_finer_is_read_as_the_mean_of_eight_voxels(settings) -> None:
    torch.manual_seed(1)
    network = OctNetFusion(**SMALL, levels=2, **settings).double().eval()
    volumes = [torch.randn(1, 1, n, n, n).double() for n in (32, 64, 128)][:2 + (settings["finer"] > 1)]
    outputs = network.run([OctreeBatch.full(volume) for volume in volumes])
    means = [8 * avg_pool3d(volume, 2) for volume in volumes[1:]]

    first = dense_level(network.levels[0], torch.cat([volumes[0], means[0]], 1), column=0)[1]
    torch.testing.assert_close(outputs[0].raw.to_dense(), first)
    carried = outputs[0].raw if settings.get("carry") == "reconstruction" else outputs[0].features
    carried = interpolate(carried.to_dense(), scale_factor=2, mode="nearest")
    parts = torch.cat([carried, volumes[1], *means[1:]], 1)
    second = dense_level(network.levels[1], parts, column=carried.shape[1])[1]
    torch.testing.assert_close(outputs[1].raw.to_dense(), second)


def test_what_only_the_finer_encoding_shows_is_not_averaged_away() -> None:
    network = OctNetFusion(**SMALL, levels=1, finer=1)
    finer = torch.ones(1, 1, 64, 64, 64)
    finer[..., 11, 30, 5] = -1.0  # one voxel of 64^3, which the coarse encoding misses
    coarse = GridOctree.from_dense(np.ones((1, 32, 32, 32), np.float32))
    inputs = [OctreeBatch.from_grids([coarse]),
              OctreeBatch.from_grids([GridOctree.from_dense(finer[0].numpy())])]
    read = network.level_input(None, inputs, 0)
    expected = torch.ones(2, 32, 32, 32)
    expected[1, 5, 15, 2] = 0.75
    torch.testing.assert_close(read.to_dense()[0], expected * torch.tensor([1.0, 8.0])[:, None, None, None])
    assert read.n_leaves == 4**3 + 7 + 7 + 7  # one tree down to voxels, all else as the coarse one


def test_the_pooled_encoding_is_the_mean_with_what_is_alike_joined() -> None:
    random = np.random.default_rng(0)
    volume = random.integers(0, 2, (1, 8, 8, 8)).repeat(8, 1).repeat(8, 2).repeat(8, 3)  # whole trees
    volume[:, :16, :16, :16] = 1
    volume[:, 40:, 40:] = random.integers(0, 3, (1, 24, 24, 64))  # and voxels
    batch = OctreeBatch.from_grids([GridOctree.from_dense(volume.astype(np.float32)),
                                    GridOctree.from_dense(np.ones((1, 64, 64, 64), np.float32))])
    found, plain = pooled_encoding(batch), grid_pool(batch, "mean")
    torch.testing.assert_close(found.to_dense(), 8 * plain.to_dense(), rtol=0, atol=0)
    expected = [GridOctree.from_dense(dense) for dense in found.to_dense().numpy()]
    roots = [(grid.trees[..., 0] & 1 == 0).sum() for grid in expected]  # trees that are one leaf
    assert [(grid.trees[..., 0] & 1 == 0).sum() for grid in found.to_grids()] == roots
    assert 0 < roots[0] < 64 and roots[1] == 64 and found.n_leaves < plain.n_leaves


def test_new_weights_for_what_is_finer_are_as_large_as_the_others_for_what_was_encoded() -> None:
    torch.manual_seed(0)
    weight = OctNetFusion(levels=1, finer=1).levels[0].first[0].weight.detach()
    assert weight[:, :10].std().item() == pytest.approx(8 * weight[:, 10:].std().item(), rel=0.05)


def test_how_many_inputs_are_read() -> None:
    plain, finer = OctNetFusion(**SMALL), OctNetFusion(**SMALL, finer=2)
    assert [plain.needs(n) for n in range(4)] == [0, 1, 2, 3]
    assert [finer.needs(n) for n in range(4)] == [0, 2, 3, 3]
    volumes = [OctreeBatch.full(torch.zeros(1, 1, n, n, n)) for n in (32, 64)]
    assert len(finer(volumes)) == 2
    one = OctNetFusion(**SMALL, levels=1, finer=2)
    assert len(one(volumes)) == len(one(volumes[:1])) == 1
    with pytest.raises(OcnfError, match="found 3, expected 1 to 2, coarse to fine"):
        one([*volumes, volumes[1]])


@pytest.mark.parametrize("encoding", Encoding)
def test_where_the_inputs_end_the_next_is_guessed_from_votes_as_they_fall(encoding: Encoding) -> None:
    """One view of a wall, fused with the truncation and with half of it: where one vote tells the other."""
    depth = np.full((1, 48, 48), 2.0, np.float32)
    depth[:, :, 24:] = 2.1
    intrinsics = np.array([[60, 0, 23.5], [0, 60, 23.5], [0, 0, 1.0]])
    views = Views(depth, intrinsics[None], np.eye(3)[None], np.array([[0.0, 0.0, 2.0]]))
    whole, half = (OctreeBatch.from_grids([fuse(views, encoding, 32, 1.0, tau)]) for tau in (0.2, 0.1))
    guess = guessed_encoding(whole, encoding).to_dense()[0] / 8
    expected = half.to_dense()[0]
    if encoding is Encoding.OCCUPANCY:  # what is within the truncation of a surface: half is not known
        expected = whole.to_dense()[0]
    if encoding is Encoding.HISTOGRAM:
        torch.testing.assert_close(guess.sum(0), torch.ones(32, 32, 32))
        assert guess.min() >= 0
        centres = torch.linspace(-1.125, 1.125, 10)
        guess, expected = (torch.tensordot(centres, x, 1) for x in (guess, expected))
        near = expected.abs() < 0.6  # beyond it a part of a vote is cut off
        assert near.sum() > 2000
        torch.testing.assert_close(guess[near], expected[near], rtol=0, atol=1e-5)
        torch.testing.assert_close(guess, expected, rtol=0, atol=0.2)  # less than a bin
    else:
        torch.testing.assert_close(guess, expected, rtol=0, atol=1e-5)
    assert len(expected.unique()) > 3 or encoding is Encoding.OCCUPANCY


def test_where_the_inputs_end_the_guess_is_read_in_place_of_the_next() -> None:
    network = OctNetFusion(**SMALL, levels=2, finer=2, extra_channels=1).double().eval()
    torch.manual_seed(0)
    volumes = [torch.randn(1, 2, n, n, n).double() for n in (32, 64)]
    volumes.append(interpolate(volumes[1], scale_factor=2, mode="nearest"))
    volumes[2][:, 0] = (2 * volumes[2][:, 0]).clamp(-1, 1)
    inputs = [OctreeBatch.full(volume) for volume in volumes]
    for known, guessed in zip(network(inputs), network(inputs[:2]), strict=True):
        torch.testing.assert_close(guessed.to_dense(), known.to_dense())


def test_the_loss_falls(inputs) -> None:
    network = OctNetFusion("tsdf", levels=1, channels=(8, 8, 8))
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    target = inputs[0].with_features(inputs[0].features.clamp(-1, 1))
    losses = []
    for _ in range(40):
        optimiser.zero_grad()
        loss = l1_loss(network(inputs[:1])[0], target)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_checkpointing_and_grids_apart_change_nothing(inputs) -> None:
    network = OctNetFusion(**SMALL, levels=2).double()
    inputs = [x.to(dtype=torch.float64) for x in inputs]
    parameters = list(network.parameters())
    gradients = []
    for on in (False, True):
        network.set_checkpointing(on)
        outputs = network(inputs)
        gradients.append(torch.autograd.grad(sum(x.features.square().sum() for x in outputs), parameters))
    torch.testing.assert_close(gradients[0], gradients[1])
    alone = [OctreeBatch.from_grids(x.to_grids()[1:]).to(dtype=torch.float64) for x in inputs]
    n_leaves = network(alone)[1].n_leaves
    torch.testing.assert_close(network(alone)[1].features, outputs[1].features[-n_leaves:], rtol=1e-5,
                               atol=1e-5)


def test_normalised_levels_train_alone_and_give_the_same_in_any_batch(inputs) -> None:
    torch.manual_seed(0)
    network = OctNetFusion(**SMALL, levels=2, normalise="batch").double().eval()
    inputs = [x.to(dtype=torch.float64) for x in inputs]
    both = network(inputs)
    alone = network([OctreeBatch.from_grids(x.to_grids()[1:]).to(dtype=torch.float64) for x in inputs])
    torch.testing.assert_close(alone[1].features, both[1].features[-alone[1].n_leaves:], rtol=1e-5, atol=1e-5)
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    network.levels[1].train()
    network.run(inputs, frozen=1)
    moved = {name for name, buffer in network.named_buffers() if not torch.equal(buffer, before[name])}
    assert moved and all(name.startswith("levels.1.") for name in moved)
    with pytest.raises(OcnfError, match="count every batch twice"):
        network.set_checkpointing(True)


def test_a_later_level_starts_from_the_one_before() -> None:
    network = OctNetFusion(**SMALL, levels=2)
    assert network.start_from_previous(1) == ["first.0.weight"]
    assert OctNetFusion(**SMALL, levels=2, context=16).start_from_previous(1) == ["first.0.weight"]
    before, after = (network.levels[i].state_dict() for i in (0, 1))
    assert all(torch.equal(before[name], after[name]) for name in before if name != "first.0.weight")
    with pytest.raises(OcnfError, match="no level before"):
        network.start_from_previous(0)


@pytest.mark.parametrize(("first", "own"), [
    ((2, 3, 5), ["bottom.0", "bottom.1", "bottom.2", "down2.1", "up2.0"]),
    ((2, 4, 4), ["down1.0", "down2.0", "down2.1", "up1.0", "up2.0", "up2.1"]),
    ((3, 3, 4), ["blend.gate", "down1.0", "head", "up1.0", "up1.1"])], ids=["deep", "middle", "wide"])
def test_of_a_level_of_other_channels_whole_layers_are_taken(first, own) -> None:
    network = OctNetFusion(**{**SMALL, "channels": (2, 3, 4)}, levels=2, level_channels=[first], blend=True,
                           normalise="batch")
    for parameter in network.parameters():
        torch.nn.init.uniform_(parameter)
    before, at_first = (copy.deepcopy(network.levels[level].state_dict()) for level in (0, 1))
    left = {name for name in network.start_from_previous(1) if not name.startswith("first.")}
    assert left == {name for name in at_first if name.startswith(tuple(f"{layer}." for layer in own))}
    for name, now in network.levels[1].state_dict().items():
        if not name.startswith("first."):
            torch.testing.assert_close(now, (at_first if name in left else before)[name])


def test_mixed_precision(inputs) -> None:
    network = OctNetFusion(**SMALL, levels=2)
    with torch.autocast("cpu", torch.bfloat16):
        result = network.run(inputs)[-1]
        loss = l1_loss(result.raw, inputs[1])
    assert loss.dtype == result.raw.features.dtype == torch.float32
    assert result.features.features.dtype == torch.bfloat16
    loss.backward()
    trained = [p for name, p in network.named_parameters() if "levels.0.head" not in name]
    assert all(p.grad is not None and p.grad.isfinite().all() for p in trained)


def test_what_the_published_code_carries_is_of_the_weights_type(inputs) -> None:
    network = OctNetFusion(**SMALL, levels=2, carry="reconstruction", output="occupancy").eval().bfloat16()
    with torch.no_grad():
        results = network.run([x.to(dtype=torch.bfloat16) for x in inputs])
    assert [result.raw.features.dtype for result in results] == [torch.bfloat16] * 2


def test_probabilities_are_finer_than_their_logits_in_mixed_precision(inputs) -> None:
    """Between 1 - 1/256 and 1 there is no bfloat16."""
    network = OctNetFusion(**SMALL, levels=1, output="occupancy").eval()
    network.levels[0].head.bias.data.fill_(7.0)
    with torch.autocast("cpu", torch.bfloat16):
        result = network.run(inputs[:1])[0]
    found = result.reconstruction.features
    assert found.dtype == torch.float32 and (found < 1).all()
    torch.testing.assert_close(found, result.raw.features.float().sigmoid(), rtol=0, atol=0)


def test_a_fourth_level_runs(make_batch) -> None:
    network = OctNetFusion(**SMALL, levels=4)
    inputs = [make_batch(level, (4 << level,) * 3, 1, 1, 0.02, torch.float32) for level in range(4)]
    with torch.no_grad():
        assert [x.shape[0] for x in network(inputs)] == [32, 64, 128, 256]


@pytest.mark.parametrize(("call", "message"), [
    (lambda n, x: n([]), "found 0, expected 1 to 2"),
    (lambda n, x: n([*x, x[1]]), "found 3, expected 1 to 2"),
    (lambda n, x: n(x[::-1]), r"inputs\[1\]: sizes do not fit; found 2 of 32x32x32, expected 2 of 128"),
    (lambda n, x: n([x[0].with_features(x[0].features.repeat(1, 2))]), "found 2, expected 1 for tsdf"),
    (lambda n, x: n([OctreeBatch.full(torch.zeros(1, 1, 16, 32, 32))]), "multiples of 32"),
    (lambda n, x: OctNetFusion(encoding="mesh"), "encoding: no such setting; found mesh, expected occupancy"),
    (lambda n, x: OctNetFusion(join="sum"), "join: no such setting"),
    (lambda n, x: n(x[0]), "inputs: not a sequence of octrees; found OctreeBatch, expected 1 to 2"),
    (lambda n, x: n([x[0], "x"]), "inputs: not a sequence of octrees"),
    (lambda n, x: n.run(x, levels=3), "levels: no such number of levels; found 3, expected 1 to 2"),
    (lambda n, x: n.run(x[:1], levels=2), "levels: no such number of levels; found 2, expected 1 to 1"),
    (lambda n, x: OctNetFusion(levels=0), "at least 1"),
    (lambda n, x: OctNetFusion(levels="2"), "levels: out of range; found 2, expected a whole number"),
    (lambda n, x: OctNetFusion(levels=True), "levels: out of range"),
    (lambda n, x: OctNetFusion(context=16.0), "context: out of range"),
    (lambda n, x: OctNetFusion(finer=-1), "finer: out of range"),
    (lambda n, x: OctNetFusion(extra_channels=-3), "extra_channels: out of range"),
    (lambda n, x: OctNetFusion(band=-1), "band: out of range"),
    (lambda n, x: OctNetFusion(band="a"), "band: out of range"),
    (lambda n, x: OctNetFusion(level_channels=5), "level_channels: no channels"),
    (lambda n, x: OctNetFusion(level_channels=[]), "level_channels: no channels"),
    (lambda n, x: OctNetFusion(channels=(1, 2)), "three positive numbers"),
])
def test_what_does_not_fit_is_refused(call, message, inputs) -> None:
    with pytest.raises(OcnfError, match=message):
        call(OctNetFusion(**SMALL, levels=2), inputs)


def test_importing_the_package_loads_nothing_heavy() -> None:
    names = ("trimesh", "pyrender", "OpenGL", "skimage", "cv2", "h5py", "matplotlib")
    everything = "from ocnf_model import *; import ocnf_model.losses, ocnf_model.metrics"
    code = f"import sys; {everything}; print([n for n in {names!r} if n in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=True).stdout.strip() == "[]"
    code = "import sys, ocnf_model; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=True).stdout.strip() == "False"
    assert all(getattr(ocnf_model, name) is not None for name in ocnf_model.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        ocnf_model.nonsense  # noqa: B018
