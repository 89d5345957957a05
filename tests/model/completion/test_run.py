"""A tiny run from end to end, on a folder written as Voxlets is: train, resume, evaluate; and the forest."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console
from typer.testing import CliRunner

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import PRETRAINED, SHIPPED, checkpoint_path
from ocnf_model.cli import app
from ocnf_model.completion import data as data_module
from ocnf_model.completion import forest as forest_module
from ocnf_model.completion import sample as sample_module
from ocnf_model.completion.data import CompletionData, held_out
from ocnf_model.completion.evaluate import run_completion_evaluation
from ocnf_model.completion.forest import StructuredForest
from ocnf_model.completion.predict import CompletionNetwork, read_threshold
from ocnf_model.completion.sample import FrameSample
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.synthetic import VIEWS_PER_SCENE, frame_name, synthetic_tabletops
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.train import completion_settings
from ocnf_model.completion.visible import Visible
from ocnf_model.completion.voxlets import list_frames, read_truth
from ocnf_model.tensorfile import read_header
from ocnf_model.training.run import train
from ocnf_model.training.settings import TrainSettings
from ocnf_model.training.train_state import load_state

SCENES = 6


def write_scene(folder: Path, scene: Tabletop, number: int) -> None:
    """One frame, in the format of Voxlets; depth in millimetres."""
    (folder / "frames").mkdir(parents=True)
    (folder / "poses").mkdir()
    depth = np.where(np.isfinite(scene.view.depth[0]), np.rint(1000 * scene.view.depth[0]), 0)
    header = f"P5\n{depth.shape[1]} {depth.shape[0]}\n65535\n".encode()
    (folder / f"frames/{number:05d}.pgm").write_bytes(header + depth.astype(">u2").tobytes())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = scene.view.R[0].T, -scene.view.R[0].T @ scene.view.T[0]
    (folder / f"poses/{number:06d}.yaml").write_text(yaml.safe_dump({
        "depth_scaling": 65.536, "frame": number, "image": f"frames/{number:05d}.pgm",
        "intrinsics": scene.view.K[0].reshape(-1).tolist(), "pose": pose.reshape(-1).tolist()}))
    tsdf = scene.tsdf.transpose(2, 1, 0).astype("<f2")
    (folder / "tsdf.dat").write_bytes(tsdf.tobytes())
    (folder / "tsdf_meta.yaml").write_text(
        f"shape: !!python/tuple {list(tsdf.shape)}\nvoxelsize: {scene.voxel}\n")


@pytest.fixture(scope="module")
def voxlets(tmp_path_factory: pytest.TempPathFactory, tabletop: Callable[..., Tabletop]) -> Path:
    """Six training scenes and one test scene, of one frame each."""
    root = tmp_path_factory.mktemp("voxlets")
    rows: dict[str, list[dict[str, object]]] = {"train": [], "test": []}
    for i in range(SCENES + 1):
        split, fold, data = ("train", "fold_0", "data") if i < SCENES else ("test", "fold_1", "data1")
        angle = 2 * np.pi * i / SCENES
        scene = tabletop((0.25 + 0.7 * np.cos(angle), 0.2 + 0.7 * np.sin(angle), 0.55))
        write_scene(root / fold / f"saved_{i}", scene, i)
        rows[split].append({"folder": f"/somewhere/{data}/", "scene": f"saved_{i}", "frames": [i]})
    (root / "train_test").mkdir()
    for split, entries in rows.items():
        (root / "train_test" / f"{split}.yaml").write_text(yaml.safe_dump(entries))
    return root


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One epoch of two samples a level, few channels."""
    file = tmp_path_factory.mktemp("settings") / "tiny.yaml"
    stage = {"epochs": 1, "batch_size": 2, "accumulate": 1, "learning_rate": 0.01}
    file.write_text(yaml.safe_dump({"channels": [2, 4, 4], "samples_per_epoch": 2, "stages": [stage]}))
    return file


def test_frames_come_back_as_they_were_written(voxlets: Path, tabletop: Callable[..., Tabletop]) -> None:
    frames = list_frames(voxlets, "train")
    assert [frame.name for frame in frames] == [f"fold_0/saved_{i}/{i}" for i in range(SCENES)]
    scene, made = frames[0].read(), tabletop((0.95, 0.2, 0.55))
    np.testing.assert_allclose(scene.tsdf, made.tsdf, atol=1e-3)
    np.testing.assert_allclose(scene.view.depth, np.where(np.isfinite(made.view.depth), made.view.depth, 0),
                               atol=6e-4)
    for solid in ((scene.tsdf < 0), Visible.of(scene.view, scene.shape, scene.voxel).tsdf < 0):
        assert solid.any()
    with pytest.raises(OcnfError, match="no such frame"):
        type(frames[0])(frames[0].scene, 99).read()
    (voxlets / "fold_0/copy").mkdir(exist_ok=True)
    (voxlets / "fold_0/copy/tsdf_meta.yaml").write_text("shape: [2, 3, 4]\nvoxelsize: 0.005\n")
    (voxlets / "fold_0/copy/tsdf.dat").write_bytes(bytes(47))
    with pytest.raises(OcnfError, match="another size"):
        read_truth(voxlets / "fold_0/copy")
    (voxlets / "fold_0/copy/tsdf.dat").write_bytes(np.full(24, np.nan, "<f2").tobytes())
    with pytest.raises(OcnfError, match="nothing of the scene is known"):
        read_truth(voxlets / "fold_0/copy")


def test_a_frame_that_looks_past_the_volume_is_no_row_of_the_table(voxlets: Path, tmp_path: Path) -> None:
    shutil.copytree(voxlets, tmp_path / "set")
    pose = np.eye(4)
    pose[:3, 3] = 50.0
    for file in (tmp_path / "set/fold_1").glob("*/poses/*.yaml"):
        fields = yaml.safe_load(file.read_text())
        file.write_text(yaml.safe_dump({**fields, "pose": pose.reshape(-1).tolist()}))
    with pytest.raises(OcnfError, match=f"fold_1/saved_{SCENES}/{SCENES}: the frame looks at no voxel"):
        run_completion_evaluation(None, str(tmp_path / "set"), out=tmp_path / "out", forest=False, figures=0)


def test_whole_scenes_are_held_out(voxlets: Path) -> None:
    training, held = held_out(list_frames(voxlets, "train"))
    assert len(held) == 1 and not {frame.scene for frame in training} & {frame.scene for frame in held}
    with pytest.raises(OcnfError, match="no such split"):
        list_frames(voxlets, "val")


def test_synthetic_tabletops_are_a_function_of_their_number() -> None:
    (a,), (b,), (c,) = (synthetic_tabletops(0, i, views=1) for i in (3, 3, 4))
    np.testing.assert_array_equal(a.tsdf, b.tsdf)
    np.testing.assert_array_equal(a.view.depth, b.view.depth)
    assert a.tsdf.shape != c.tsdf.shape or not np.array_equal(a.tsdf, c.tsdf, equal_nan=True)
    visible = Visible.of(a.view, a.shape, a.voxel)
    seen = (visible.tsdf < -0.005) & visible.judged
    assert (a.occupied & seen).sum() > 0.6 * seen.sum() > 100  # what is seen to be solid is so in truth
    assert (a.tsdf[visible.free & (visible.tsdf > 0.02)] > 0).mean() > 0.99


def test_train_resume_and_evaluate(voxlets: Path, settings: Path, tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "results"
    arguments = ["complete", "train", "--data", str(voxlets), "--out", str(run), "--settings", str(settings),
                 "--synthetic", "1", "--device", "cpu"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    weights = {file.name: file.read_bytes() for file in run.glob("level-*.safetensors")}
    assert set(weights) == {"level-1.safetensors", "level-2.safetensors"}
    assert 0.2 <= read_threshold(run) <= 0.7
    assert CliRunner().invoke(app, arguments).exit_code == 0  # all is done: nothing changes
    assert {name: (run / name).read_bytes() for name in weights} == weights

    scene = list_frames(voxlets, "test")[0].read()
    probability = CompletionNetwork(run, "cpu").probability(scene)
    assert probability.shape == scene.shape and 0 <= probability.min() < probability.max() <= 1
    done = CliRunner().invoke(app, ["complete", "evaluate", str(run), "--data", str(voxlets), "--out",
                                    str(out), "--no-forest", "--figures", "1", "--device", "cpu"])
    assert done.exit_code == 0, done.output
    assert {"everything occupied", "extrusion", "ours"} <= {
        row.split(",")[1] for row in (out / "frames.csv").read_text().splitlines()}
    assert "| ours |" in (out / "completion.md").read_text()
    assert (out / "completion.png").read_bytes().startswith(b"\x89PNG")


def test_a_finer_encoding_is_not_read() -> None:
    with pytest.raises(OcnfError, match="reads its own resolution alone"):
        completion_settings({"finer": 1})
    assert completion_settings({"finer": 0}).finer == 0


def test_settings_that_would_change_nothing_are_refused() -> None:
    for name, value in {"augment": "all", "categories": ["cup"], "on_error": "skip", "shuffle_buffer": 8,
                        "resolutions": [32, 64], "train_split": "test", "val_split": "test", "variant": "v2",
                        "mixture": [{"variant": "v2"}], "encoding": "histogram", "output": "tsdf",
                        "extra_channels": 3}.items():
        with pytest.raises(OcnfError, match=f"some.yaml: {name}: it would have no effect.*Leave it out"):
            completion_settings({name: value}, "some.yaml")
        completion_settings({name: value}, begun=True)  # such a run was begun by a version that let it pass
    with pytest.raises(OcnfError, match="resolutions: it would have no effect"):
        completion_settings({"levels": 1, "resolutions": [128]})
    assert completion_settings({"levels": 1, "resolutions": [64]}).resolutions == (64,)


def test_settings_that_a_run_writes_down_make_another() -> None:
    """All fields are in them, those without effect too."""
    chosen = completion_settings()
    assert completion_settings(chosen.to_dict()) == chosen
    for level in (1, 2):
        header = read_header(checkpoint_path(SHIPPED[PRETRAINED] / "completion", level))
        assert completion_settings(header["settings"]).levels == 2


def test_scenes_of_another_seed_are_other_samples(voxlets: Path, tmp_path: Path,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    made, saved = [], set()

    def make(seed: int, index: int) -> list[Any]:
        made.append((seed, index))
        return [SimpleNamespace(name=frame_name(seed, index, view)) for view in range(VIEWS_PER_SCENE)]

    def save(file: Path, sample: Any) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"")
        saved.add(file.name)

    monkeypatch.setattr(data_module, "synthetic_tabletops", make)
    monkeypatch.setattr(data_module, "save_sample", save)
    monkeypatch.setattr(FrameSample, "of", lambda scene: scene)
    console = Console(quiet=True)
    for seed in (0, 1, 0):
        CompletionData(voxlets, 2, seed).prepare(tmp_path, completion_settings(), console)
    assert made == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert len(saved) == SCENES + 4 * VIEWS_PER_SCENE
    monkeypatch.setattr(sample_module, "SAMPLE_VERSION", "another")
    CompletionData(voxlets, 1, 0).prepare(tmp_path, completion_settings(), console)
    assert len(saved) == 2 * SCENES + 5 * VIEWS_PER_SCENE


def test_a_run_goes_on_where_it_was_stopped_with_the_same_result(voxlets: Path, tmp_path: Path) -> None:
    chosen = completion_settings({
        "channels": [2, 4, 4], "levels": 1, "samples_per_epoch": 4, "save_every": 1,
        "stages": [{"epochs": 2, "batch_size": 2, "accumulate": 1, "learning_rate": 0.01}]})

    class Stopping(CompletionData):
        def validation(self, folder, settings, level):  # type: ignore[no-untyped-def]
            found = super().validation(folder, settings, level)
            if self.armed:
                found._batches = self.stop  # type: ignore[method-assign]
            return found

        armed = False

        def stop(self, epoch, steps):  # type: ignore[no-untyped-def]
            raise KeyboardInterrupt
            yield

    whole = train(CompletionData(voxlets, 1), tmp_path / "whole", chosen, device="cpu").state_dict()
    source = Stopping(voxlets, 1)
    source.armed = True
    with pytest.raises(KeyboardInterrupt):
        train(source, tmp_path / "parts", chosen, device="cpu")
    parts = train(CompletionData(voxlets, 1), tmp_path / "parts", chosen, device="cpu").state_dict()
    assert all(np.array_equal(whole[name].numpy(), parts[name].numpy()) for name in whole)


def test_the_first_level_may_be_given_other_epochs(voxlets: Path, tmp_path: Path) -> None:
    """Those with synthetic scenes alone are over when it goes on: they stay as many as they were."""
    def chosen(epochs: int) -> TrainSettings:
        return completion_settings({
            "channels": [2, 4, 4], "levels": 1, "samples_per_epoch": 2,
            "stages": [{"epochs": epochs, "batch_size": 2, "accumulate": 1, "learning_rate": 0.01}]})

    for epochs in (2, 5):
        train(CompletionData(voxlets, 1), tmp_path / "run", chosen(epochs), device="cpu")
        state = load_state(tmp_path / "run")[0]
        assert (state.epoch, state.loader["synthetic_epochs"]) == (epochs, 1)
    data = CompletionData(voxlets, 1)
    dataset, anew = (data.training(tmp_path / "run", chosen(5), 0) for _ in range(2))
    dataset.load_state_dict({**state.loader, "epoch": 1, "step": 0})
    anew.set_epoch(1)
    assert any("synthetic" not in key for batch in dataset for key in batch.keys)
    assert all("synthetic" in key for batch in anew for key in batch.keys)
    with pytest.raises(OcnfError, match="synthetic_epochs"):
        dataset.load_state_dict({**state.loader, "synthetic_epochs": -1})


def test_the_forest_learns_where_solids_go_on(voxlets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forest_module, "_TREES", 6)
    monkeypatch.setattr(forest_module, "_PLACED", 150)
    scenes = [frame.read() for frame in list_frames(voxlets, "train")]
    forest = StructuredForest(scenes[:5])
    judged = Visible.of(scenes[5].view, scenes[5].shape, scenes[5].voxel).judged
    probability = forest.probability(scenes[5])
    assert probability.shape == scenes[5].shape and 0 <= probability.min() <= probability.max() <= 1
    everything = Scores.of(scenes[5].occupied, np.ones(scenes[5].shape, bool), judged)
    assert Scores.of(scenes[5].occupied, probability >= 0.5, judged).iou > 0.5 > everything.iou
    np.testing.assert_array_equal(StructuredForest(scenes[:5]).probability(scenes[5]), probability)
