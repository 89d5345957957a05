"""Checkpoints: what is written is what is read, and everything else is refused."""

from __future__ import annotations

import json
import pickle
import random
import resource
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors
import safetensors.torch
import torch
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import SHIPPED, checkpoint_sha256, load_level, load_run, open_run, save_checkpoint
from ocnf_model.header import Architecture, Header, TrainingData
from ocnf_model.info import print_run, training_table
from ocnf_model.network import OctNetFusion
from ocnf_model.tensorfile import TensorKind, read_tensors, write_tensors

ARCHITECTURE = Architecture(encoding="tsdf", join="concat", carry="features", output="tsdf",
                            channels=(2, 3, 4), band=1.0)
DATA = TrainingData(name="d", checksum="0" * 64, variant="v2", n_train=3, n_val=2, extent=3.0,
                 truncation_voxels=2.0)


def write_run(folder: Path, seed: int = 0, **architecture) -> OctNetFusion:
    """Two untrained levels, as a run leaves them."""
    torch.manual_seed(seed)
    chosen = ARCHITECTURE.model_copy(update=architecture)
    network = chosen.network(2)
    folder.mkdir(exist_ok=True)
    for level in (1, 2):
        header = Header(level=level, resolution=16 << level, architecture=chosen, data=DATA, epoch=1, steps=4,
                        metrics={"mad_mm": 1.5}, settings={}, torch="2",
                        built_on=checkpoint_sha256(folder, 1) if level == 2 else None)
        save_checkpoint(folder, header, network.levels[level - 1].state_dict())
    return network


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_run(tmp_path / "run")
    return tmp_path / "run"


def rewrite(path: Path, change) -> None:
    """Read a checkpoint, let `change(weights, header)` alter both, and write it with a checksum that fits."""
    weights, header = read_tensors(path)
    change(weights, header)
    write_tensors(path, weights, header)


def without_checksum(path: Path) -> None:
    """Make a checkpoint one of before there were checksums, with safetensors alone."""
    weights = safetensors.torch.load(path.read_bytes())
    with safetensors.safe_open(path, "pt") as file:
        header = json.loads(file.metadata()["ocnf"])
    del header["sha256"]
    path.write_bytes(safetensors.torch.save(weights, {"ocnf": json.dumps(header)}))


def test_what_is_written_is_what_is_read(tmp_path) -> None:
    network = write_run(tmp_path / "run")
    run = open_run(tmp_path / "run")
    loaded = run.network.state_dict()
    assert all(torch.equal(tensor, loaded[name]) for name, tensor in network.state_dict().items())
    assert not run.network.training and run.headers[1].architecture == ARCHITECTURE
    assert run.resolutions == [32, 64] and run.data.tau(64) == pytest.approx(2 * 3 / 64)
    assert json.loads((tmp_path / "run/level-2.json").read_text()) == run.headers[1].to_dict()
    assert len(load_run(tmp_path / "run", levels=1).levels) == 1
    write_run(tmp_path / "again")
    assert (tmp_path / "again/level-2.safetensors").read_bytes() \
        == (tmp_path / "run/level-2.safetensors").read_bytes()


def test_weights_in_half_precision_are_read_as_single(folder: Path) -> None:
    whole = load_run(folder)
    for level in (1, 2):
        path = folder / f"level-{level}.safetensors"
        rewrite(path, lambda weights, header: (
            weights.update({name: value.half() for name, value in weights.items()}),
            header.update(built_on=checkpoint_sha256(folder, 1) if header["level"] == 2 else None)))
    for name, value in load_run(folder).state_dict().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, whole.state_dict()[name].half().float())
    rewrite(path, lambda weights, header: weights.update({"head.bias": weights["head.bias"].bfloat16()}))
    with pytest.raises(OcnfError, match=r"head.bias: .*BF16 \(1,\), expected F32 \(1,\)"):
        load_run(folder)


@pytest.mark.parametrize(("change", "message"), [
    (lambda w, h: h.update(schema=2), "another schema version; found 2, expected 1"),
    (lambda w, h: h.pop("schema"), "another schema version"),
    (lambda w, h: h.update(level=2), "level: the checkpoint does not fit the network; found 2, expected 1"),
    (lambda w, h: h.update(extra=1), "extra: unknown field"),
    (lambda w, h: h["architecture"].update(join="add"), "shape|does not fit"),
    (lambda w, h: h["architecture"].update(channels=[2, 3]), "architecture.channels"),
    (lambda w, h: h["data"].pop("extent"), "data.extent: the field is missing"),
    (lambda w, h: w.pop("head.bias"), "head.bias: the checkpoint does not fit the network; found nothing"),
    (lambda w, h: w.update(extra=torch.zeros(1)), "extra: the checkpoint does not fit.*found there"),
    (lambda w, h: w.update({"head.bias": torch.zeros(2)}), r"head.bias: .*F32 \(2,\).*F32 \(1,\)"),
    (lambda w, h: w.update({"head.bias": w["head.bias"].bfloat16()}), "head.bias: .*found BF16"),
    (lambda w, h: w["head.bias"].fill_(float("nan")), "head.bias: weights that are not finite"),
])
def test_a_checkpoint_that_is_wrong_is_refused(change, message, folder) -> None:
    rewrite(folder / "level-1.safetensors", change)
    with pytest.raises(OcnfError, match=f"level-1.safetensors.*({message})"):
        open_run(folder)


@pytest.mark.parametrize("field", ["encoding", "join", "carry", "output", "channels", "band"])
def test_a_network_of_another_kind_is_refused(field, folder) -> None:
    other = {"encoding": "tdf_occupancy", "join": "add", "carry": "reconstruction", "output": "occupancy",
             "channels": (2, 3, 5), "band": 3.0}[field]
    network = OctNetFusion(**{**ARCHITECTURE.model_dump(), "levels": 2, field: other})
    with pytest.raises(OcnfError, match=f"{field}: the checkpoint does not fit the network"):
        load_level(folder, network, 1)


def test_levels_of_different_runs_are_not_mixed(folder, tmp_path) -> None:
    write_run(tmp_path / "other", seed=1)
    (folder / "level-1.safetensors").write_bytes((tmp_path / "other/level-1.safetensors").read_bytes())
    with pytest.raises(OcnfError, match="built_on: the level was trained on other weights"):
        open_run(folder)
    assert len(open_run(folder, levels=1).headers) == 1


def test_levels_that_are_missing(folder, tmp_path) -> None:
    with pytest.raises(OcnfError, match="levels: too few levels are trained; found 2, expected at least 3"):
        load_run(folder, levels=3)
    (folder / "level-1.safetensors").unlink()
    with pytest.raises(OcnfError, match="too few levels"):
        load_run(folder)
    with pytest.raises(OcnfError, match="no such run"):
        load_run(tmp_path / "nothing")


def flips(blob: bytes, seed: int) -> Iterator[bytes]:
    """The file with one bit flipped, of some bytes of its header and of some of the tensors'."""
    chance = random.Random(seed)
    header = 8 + int.from_bytes(blob[:8], "little")
    for at in (*range(8), *range(8 + seed, header, 11), *range(header, len(blob), 211), len(blob) - 1):
        yield blob[:at] + bytes([blob[at] ^ 1 << chance.randrange(8)]) + blob[at + 1:]


@pytest.mark.parametrize("level", [1, 2])
def test_every_flipped_bit_is_found(level, folder) -> None:
    path = folder / f"level-{level}.safetensors"
    for damaged in flips(path.read_bytes(), level):
        path.write_bytes(damaged)
        with pytest.raises(OcnfError, match=f"level-{level}.safetensors"):
            open_run(folder, levels=level)


def test_a_checkpoint_of_before_checksums_is_read_with_a_note(folder, caplog) -> None:
    expected = open_run(folder, levels=1).network.state_dict()
    assert not caplog.records
    without_checksum(folder / "level-1.safetensors")
    loaded = open_run(folder, levels=1).network.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.items())
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "level-1.safetensors is of a version that wrote no checksums" in caplog.text


@pytest.mark.parametrize(("channels", "message"), [
    ([10**9, 1, 1], r"architecture.channels\[0\]: .*found 1000000000, expected .*4096"),
    ([1000, 1000, 2000], r"does not fit the network; found F32 .*expected F32 .*000"),
    ([4096, 4096, 4096], "does not fit the network"),
])
def test_channels_are_compared_with_the_file_before_anything_is_built(channels, message, folder) -> None:
    rewrite(folder / "level-1.safetensors", lambda w, h: h["architecture"].update(channels=channels))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(OcnfError, match=message):
        open_run(folder, levels=1)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kB"


@pytest.mark.parametrize("changes", [{}, {"join": "add"}, {"carry": "reconstruction"},
                                     {"output": "occupancy", "encoding": "histogram"}])
def test_the_kinds_of_a_level_are_those_of_the_network(changes) -> None:
    chosen = Architecture(**{**ARCHITECTURE.model_dump(), **changes})
    for level, built in enumerate(chosen.network(3).levels):
        assert chosen.kinds(level) == {name: TensorKind.of(t) for name, t in built.state_dict().items()}


@pytest.mark.parametrize("change", [
    lambda h: h.update(level=10**9), lambda h: h.update(level="1"), lambda h: h.update(resolution=10**12),
    lambda h: h.update(epoch=10**300), lambda h: h.update(steps=1.5), lambda h: h.update(epoch=True),
    lambda h: h.update(metrics={"mad_mm": "1"}), lambda h: h["architecture"].update(band=-1),
    lambda h: h.update(sha256=7), lambda h: h.update(settings=[]),
])
def test_every_field_of_the_header_is_bounded(change, folder) -> None:
    rewrite(folder / "level-1.safetensors", lambda w, h: change(h))
    with pytest.raises(OcnfError, match=r"level-1\.safetensors"):
        open_run(folder, levels=1)


def test_a_huge_file_is_not_read(folder) -> None:
    with (folder / "level-1.safetensors").open("r+b") as file:
        file.truncate(2**42)  # sparse
    with pytest.raises(OcnfError, match="too large for a checkpoint"):
        open_run(folder)


def test_every_truncation_is_found(folder) -> None:
    path = folder / "level-1.safetensors"
    whole = path.read_bytes()
    for size in (*range(0, len(whole), 997), len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(OcnfError, match=r"level-1\.safetensors"):
            read_tensors(path)


def test_a_planted_pickle_is_not_run(folder, tmp_path) -> None:
    class Payload:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    for blob in (pickle.dumps(Payload()), b""):
        (folder / "level-1.safetensors").write_bytes(blob)
        with pytest.raises(OcnfError, match="not a whole safetensors file"):
            load_run(folder)
    torch.save(Payload(), folder / "level-1.safetensors")
    with pytest.raises(OcnfError, match="not a whole safetensors file"):
        load_run(folder)
    assert not (tmp_path / "executed").exists()


def test_data_that_means_something_else_is_refused(folder) -> None:
    run = open_run(folder)
    run.check_truncation("scan", 2.0001)
    for truncation_voxels in (1.9, 3.0):
        with pytest.raises(OcnfError, match=rf"truncation_voxels: .*found {truncation_voxels}, expected 2.0"):
            run.check_truncation("scan", truncation_voxels)


def test_pretrained_weights_are_read_or_their_lack_is_said(monkeypatch, folder, tmp_path) -> None:
    monkeypatch.setitem(SHIPPED, "pretrained", folder)
    assert len(load_run("pretrained").levels) == 2
    monkeypatch.setitem(SHIPPED, "pretrained", tmp_path)
    with pytest.raises(OcnfError, match=r"without pretrained weights.*ocnf-model train"):
        load_run("pretrained")


def test_info_of_a_folder_without_a_first_level_says_what_is_missing(folder) -> None:
    (folder / "level-1.safetensors").unlink()
    with pytest.raises(OcnfError, match=r"not a run; expected level-1\.safetensors, or settings\.json"):
        print_run(folder, Console())


def test_info_has_a_column_for_every_figure_and_a_dash_where_a_level_lacks_it(folder) -> None:
    run = open_run(folder)
    figures = ({"mad_mm": 2.0, "iou": 0.5}, {"iou": 0.75, "f_score": 0.875})
    headers = tuple(header.model_copy(update={"metrics": metrics})
                    for header, metrics in zip(run.headers, figures, strict=True))
    columns = {str(column.header): list(column.cells)
               for column in training_table(replace(run, headers=headers)).columns}
    assert {name: columns.get(name) for name in ("mad_mm", "iou", "f_score")} == {
        "mad_mm": ["2", "-"], "iou": ["0.5", "0.75"], "f_score": ["-", "0.875"]}
