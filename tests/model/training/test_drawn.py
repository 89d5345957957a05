"""Training on a manifest, and on mixtures of data sets, variants and manifests."""

from __future__ import annotations

import io
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from rich.console import Console
from typer.testing import CliRunner

import ocnf_data.generation.account as account
from ocnf_data import MixtureDataset, ShardDataset, generate
from ocnf_data.errors import OcnfError
from ocnf_data.generation.outcome import Report
from ocnf_data.generation.records import Failure
from ocnf_data.manifest import Manifest
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.shapes import make_shape
from ocnf_model.checkpoint import open_run
from ocnf_model.cli import app
from ocnf_model.training.crops import draw_corners
from ocnf_model.training.data import open_data
from ocnf_model.training.run import train
from ocnf_model.training.train_state import load_state, save_state

from .conftest import MANIFEST
from .test_processes import ENVIRONMENT, TRAINS_UNTIL_KILLED

SECTION = {"samples_per_epoch": 5, "views": [1, 3], "rotate": "any", "repeat": 2}
STAGES = [{"epochs": 2, "batch_size": 1, "accumulate": 2, "learning_rate": 1e-3}]


@pytest.fixture(scope="module")
def manifest(tmp_path_factory) -> str:
    """The tiny data set's manifest, with what is drawn anew."""
    path = tmp_path_factory.mktemp("manifest") / "drawn.yaml"
    path.write_text(yaml.safe_dump({**MANIFEST, "synthesis": SECTION}))
    return str(path)


@pytest.fixture(scope="module")
def variants(tmp_path_factory) -> str:
    """A data set with three variants of inputs."""
    folder = tmp_path_factory.mktemp("variants") / "set"
    inputs = [{"name": f"v{n}", "views": n, "sigma": 0.01, "encodings": ["tsdf"]} for n in (1, 2, 4)]
    generate(Manifest.from_dict({**MANIFEST, "inputs": inputs}), str(folder))
    return str(folder)


@pytest.fixture(scope="module")
def other(tmp_path_factory) -> str:
    """The tiny data set, but its inputs have another name."""
    folder = tmp_path_factory.mktemp("other") / "set"
    generate(Manifest.from_dict({**MANIFEST, "inputs": [{**MANIFEST["inputs"][0], "name": "two"}]}),
             str(folder))
    return str(folder)


@pytest.fixture(scope="module")
def finished(manifest, small, tmp_path_factory) -> Path:
    """A run on the manifest."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    train(manifest, folder, small(stages=STAGES), device="cpu")
    return folder


def test_a_manifest_trains_and_its_validation_split_is_made_once(finished, manifest, small, tiny) -> None:
    run = open_run(finished)
    assert run.resolutions == [32, 64]
    assert (run.data.n_train, run.data.n_val, run.data.variant) == (5, 2, "v2")
    # The validation set is the data set's own: draws for training are no part of it.
    made, stored = (next((Path(folder) / "val").glob("*.tar")).read_bytes()
                    for folder in (finished / "validation", tiny))
    assert made == stored
    assert not (finished / "validation" / "train").exists()
    before = {path: path.stat().st_mtime_ns for path in (finished / "validation" / "val").glob("shard-*")}
    train(manifest, finished, small(stages=STAGES), device="cpu")
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_a_data_set_may_validate_in_the_place_of_the_split(finished, manifest, small, tiny, out) -> None:
    train(manifest, out, small(stages=STAGES), device="cpu", val=tiny)
    assert not (out / "validation").exists()
    for level in (1, 2):
        name = f"level-{level}.safetensors"
        assert (out / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.parametrize("mixed", [False, True])
def test_a_killed_run_ends_with_the_same_weights(manifest, variants, small, tmp_path, mixed) -> None:
    parts = [{"variant": "v1", "weight": 2}, {"variant": "v4"}, {"data": manifest, "weight": 1.5}]
    settings = small(stages=STAGES, save_every=1, augment="flips", levels=1,
                     **({"mixture": parts, "samples_per_epoch": 5} if mixed else {}))
    data = variants if mixed else manifest
    train(data, tmp_path / "whole", settings, device="cpu")
    file, out = tmp_path / "settings.json", tmp_path / "killed"
    file.write_text(json.dumps(settings.to_dict()))
    # Five batches an epoch, a step and a state after the second, the fourth and the fifth.
    process = subprocess.run(
        [sys.executable, "-c", TRAINS_UNTIL_KILLED, "8", "train", data, "--out", str(out),
         "--settings", str(file), "--workers", "2", "--device", "cpu"],
        env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, timeout=180, check=False)
    assert process.returncode == -signal.SIGKILL, process.stderr
    place = load_state(out)[0]
    assert (place.level, place.epoch, place.step) == (0, 1, 2)
    shutil.rmtree(out / "cache", ignore_errors=True)  # what it held is made again
    train(data, out, settings, device="cpu")
    name = "level-1.safetensors"
    assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_ground_truths_that_epochs_share_go_with_the_end_and_are_not_missed(
        manifest, small, tmp_path, monkeypatch) -> None:
    there: list[bool] = []

    def noting(folder, *others):
        there.append((folder / "cache").is_dir())
        save_state(folder, *others)

    monkeypatch.setattr("ocnf_model.training.stage.save_state", noting)
    whole, longer = tmp_path / "whole", tmp_path / "longer"
    settings = small(stages=STAGES, levels=1)
    train(manifest, whole, settings, device="cpu")
    assert all(there) and not (whole / "cache").exists()
    train(manifest, longer, small(stages=[{**STAGES[0], "epochs": 1}], levels=1), device="cpu")
    train(manifest, longer, settings, device="cpu")  # goes on within a season of two epochs
    assert not (longer / "cache").exists()
    ours, theirs = (load_state(folder)[1] for folder in (longer, whole))
    assert ours.keys() == theirs.keys() and all(ours[name].equal(theirs[name]) for name in ours)


def test_a_run_stopped_while_making_the_validation_set_is_taken_up(manifest, small, out, monkeypatch) -> None:
    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(account, "write_dataset", stop)
    with pytest.raises(KeyboardInterrupt):
        train(manifest, out, small(levels=1), device="cpu")
    monkeypatch.undo()
    assert (out / "validation" / "plan.json").exists()
    assert not (out / "settings.json").exists()
    train(manifest, out, small(levels=1), device="cpu")
    assert open_run(out).data.n_val == 2


def test_two_ranks_have_the_losses_of_one_with_twice_the_batch(manifest, small, tmp_path) -> None:
    stages = [{"epochs": 2, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3}]
    train(manifest, tmp_path / "one", small(stages=stages, levels=1), device="cpu")
    stages[0]["batch_size"] = 1
    file, out = tmp_path / "settings.json", tmp_path / "two"
    file.write_text(json.dumps(small(stages=stages, levels=1).to_dict()))
    process = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--local-addr", "127.0.0.1",
         "--nproc-per-node", "2", "-m", "ocnf_model.cli", "train", manifest, "--out", str(out), "--settings",
         str(file), "--device", "cpu"],
        env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, timeout=180, check=False)
    assert process.returncode == 0, process.stderr
    one, two = (load_state(folder)[0].rows for folder in (tmp_path / "one", out))
    assert [row.train_loss for row in two] == pytest.approx([row.train_loss for row in one], rel=1e-4)
    assert [row.val_mad for row in two] == pytest.approx([row.val_mad for row in one], rel=1e-4)


def test_a_mixture_draws_variants_and_the_network_is_not_told(variants, manifest, small, out) -> None:
    settings = small(levels=1, samples_per_epoch=40, mixture=[
        {"variant": "v1"}, {"variant": "v4", "weight": 2}, {"data": manifest}])
    source = open_data(variants, settings)
    batches = list(source.training(out, settings, 0))
    members = {slot.member for batch in batches for slot in batch.slots}
    assert members == {"mixture-tsdf-32.oct", "target-32.oct"}
    drawn = [len(meta["views"]) if "views" in meta else 0 for batch in batches for meta in batch.meta]
    assert drawn.count(0) > 15  # of the data set; the rest comes from the manifest with 1 to 3 views
    assert {1, 2, 3} & set(drawn)
    assert source.validation(out, settings, 0).variant == "v1"  # the manifest's first, if nobody says
    assert source.validation(out, settings.model_copy(update={"variant": "v4"}), 0).variant == "v4"


def test_a_bad_mesh_of_a_part_gives_place_to_another(tiny, small, tmp_path) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for number in range(3):
        shape = make_shape("table", 0, number, "train")
        (meshes / f"m{number}.off").write_bytes(WRITERS[".off"](shape.vertices, shape.faces))
    (meshes / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n")
    path = tmp_path / "part.yaml"
    path.write_text(yaml.safe_dump({**MANIFEST, "source": {"kind": "folder", "shares": {"train": 1.0}}}))
    settings = small(levels=1, samples_per_epoch=400, mixture=[
        {"weight": 1e-3}, {"data": str(path), "meshes": str(meshes)}])
    assert settings.on_error == "raise"  # which is about data sets
    dataset = open_data(tiny, settings).training(tmp_path, settings, 0)
    lost = [one.key for _, batch in zip(range(8), dataset, strict=False) for one in batch.lost]
    assert lost and set(lost) == {"bad.off"}


def test_parts_are_drawn_by_seeds_of_their_own(variants, small, out) -> None:
    settings = small(levels=1, samples_per_epoch=60, seed=3, augment="all",
                     mixture=[{"variant": name} for name in ("v1", "v2", "v4")])

    def orders() -> list[list[str]]:
        dataset = open_data(variants, settings).training(out, settings, 0)
        assert isinstance(dataset, MixtureDataset)
        met: list[list[str]] = [[], [], []]
        for i, draw in enumerate(draw for batch in dataset for draw in batch.draws):
            met[dataset.supply().part(0, i)].append(draw)
        return met

    def keys(met: list[str]) -> list[str]:
        return [draw.split(" ")[0] for draw in met[:5]]

    first, second, third = orders()
    assert sorted(keys(first)) == sorted(keys(second)) == sorted(keys(third))  # each of the five
    assert len({tuple(keys(met)) for met in (first, second, third)}) == 3
    assert first[:5] == [batch.keys[0] for batch in ShardDataset(variants, "train", 32, "tsdf", "v1", seed=3)]
    one_seed = settings.model_copy(update={"stages": (settings.stage(0).model_copy(update={"epochs": 1}),)})
    train(variants, out, one_seed.model_copy(update={"samples_per_epoch": 2}), device="cpu")
    assert orders() == [first, second, third]
    record = out / "settings.json"  # as an earlier version wrote it
    record.write_text(record.read_text().replace('"apart": true,', ""))
    before = orders()
    assert keys(before[0]) == keys(before[1]) == keys(before[2]) == keys(first)
    assert all(" " not in draw for met in before for draw in met)


def test_boxes_of_a_sample_that_comes_again_are_others(tiny, small, out, monkeypatch) -> None:
    names: list[str] = []

    def noting(truth, size, seed, epoch, keys, boxes=1):
        names.extend(keys)
        return draw_corners(truth, size, seed, epoch, keys, boxes)

    monkeypatch.setattr("ocnf_model.training.stage.draw_corners", noting)
    settings = small(levels=1, resolutions=[64], samples_per_epoch=10, stages=[{**STAGES[0], "epochs": 1,
                                                                                "crop": 64}])
    train(tiny, out, settings, device="cpu")
    assert len(names) == len(set(names)) == 10


def test_an_epoch_of_a_plain_data_set_may_have_another_length(tiny, small, out) -> None:
    settings = small(levels=1, samples_per_epoch=3, stages=[STAGES[0] | {"accumulate": 1}])
    train(tiny, out, settings, device="cpu")
    assert [row.steps for row in load_state(out)[0].rows] == [3, 6]


def test_settings_of_a_plain_run_are_written_as_before_mixtures_were(tiny, small, out) -> None:
    train(tiny, out, small(levels=1), device="cpu")
    written = json.loads((out / "settings.json").read_bytes())["settings"]
    header = json.loads((out / "level-1.json").read_bytes())["settings"]
    assert not {"mixture", "samples_per_epoch"} & {*written, *header}


def test_another_manifest_or_mixture_is_refused(finished, manifest, variants, small, tmp_path, out) -> None:
    other = tmp_path / "other.yaml"
    for changes, message in (({"synthesis": {**SECTION, "views": [1, 4]}}, "another data set"),
                             ({"inputs": [{"name": "v2", "views": 3, "sigma": 0.01, "encodings": ["tsdf"]}]},
                              r"inputs\[0\]")):
        other.write_text(yaml.safe_dump({**MANIFEST, "synthesis": SECTION, **changes}))
        with pytest.raises(OcnfError, match=message):
            train(str(other), finished, small(stages=STAGES), device="cpu")
    parts = [{"variant": "v1"}, {"variant": "v2"}]
    settings = small(levels=1, mixture=parts, samples_per_epoch=4)
    train(variants, out, settings, device="cpu")
    parts[1]["weight"] = 3.0
    with pytest.raises(OcnfError, match=r"mixture\[1\].weight"):
        train(variants, out, small(levels=1, mixture=parts, samples_per_epoch=4), device="cpu")
    with pytest.raises(OcnfError, match="samples_per_epoch"):
        train(variants, out, small(levels=1, mixture=parts), device="cpu")
    with pytest.raises(OcnfError, match="mixture"):
        train(variants, out, small(levels=1, variant="v1"), device="cpu")


@pytest.mark.parametrize("named", [None, "v2", "two"])
def test_inputs_may_have_another_name_in_what_is_validated_with(tiny, other, small, tmp_path, named) -> None:
    heard = Console(file=io.StringIO(), width=200)
    same = train(tiny, tmp_path / "same", small(levels=1), device="cpu")
    settings = small(levels=1, variant=named)
    ours = train(tiny, tmp_path / "run", settings, device="cpu", val=other, console=heard)
    assert all(torch.equal(tensor, same.state_dict()[name]) for name, tensor in ours.state_dict().items())
    assert open_run(tmp_path / "run").data.variant == "v2"
    assert "validating with the inputs two: the data set that is validated with has no v2" in \
        heard.file.getvalue()
    assert ("training on the inputs v2: the data set has no two" in heard.file.getvalue()) == (named == "two")
    rows = [load_state(tmp_path / name)[0].rows[0].val_mad for name in ("same", "run")]
    assert rows[0] == rows[1]
    train(tiny, tmp_path / "run", small(levels=1), device="cpu", val=other)  # it is the same run


def test_inputs_that_cannot_be_told_apart_are_named(tiny, variants, other, manifest, small, out) -> None:
    for data, val, named, message in (
            (other, variants, None, f"{variants}: variant: .*found two, expected one of v1, v2, v4"),
            (other, variants, "v2", f"{other}: variant: .*found v2, expected one of two"),
            (variants, other, None, "several input variants; expected one of v1, v2, v4"),
            (variants, other, "two", f"{variants}: variant: .*found two, expected one of v1, v2, v4"),
            (variants, other, "v9", "variant: the data set has no such octrees; found v9"),
            (manifest, other, "v9", "variant: the data set has no such octrees; found v9")):
        with pytest.raises(OcnfError, match=message):
            train(data, out, small(levels=1, variant=named), device="cpu", val=val)
    assert not (out / "settings.json").exists()
    for data, val, named in ((tiny, variants, None), (variants, other, "v1"), (manifest, other, "v2")):
        source = open_data(data, small(variant=named), val=val)
        settings = small(variant=named)
        settings = source.with_variant(settings) if data != manifest else settings
        assert source.validation(out, settings, 0).variant == ("v2" if val == variants else "two")
        if data != manifest:
            assert source.training(out, settings, 0).variant == (named or "v2")


def test_all_epochs_of_a_run_are_validated_with_the_same_samples(tiny, variants, small, out) -> None:
    settings = small(levels=1, samples_per_epoch=2, variant="v2",
                     mixture=[{"data": variants, "variant": "v1"}], stages=[STAGES[0] | {"epochs": 1}])
    train(tiny, out, settings, device="cpu")
    fields = json.loads((out / "settings.json").read_text())
    for data, val in ((variants, None), (tiny, variants)):
        with pytest.raises(OcnfError, match="validation: the run is validated with another data set"):
            train(data, out, settings, device="cpu", val=val)
    train(variants, out, settings, device="cpu", val=tiny)  # which is the same
    del fields["validation"]  # as versions before wrote it
    (out / "settings.json").write_text(json.dumps(fields))
    train(tiny, out, settings, device="cpu", val=variants)


def test_what_a_manifest_lacks_is_said(small, tmp_path, out, tiny) -> None:
    path = tmp_path / "lacks.yaml"
    for changes, message in (
            ({"source": {**MANIFEST["source"], "counts": {"train": 3}}}, r"no samples to validate.*--val"),
            ({"inputs": [{"name": "v2", "views": 2, "encodings": ["occupancy"]}]}, "has the encoding"),
            ({"source": {"kind": "folder"}}, "--meshes ROOT"),
            ({"truncation_voxels": 3.0}, "truncation_voxels")):
        path.write_text(yaml.safe_dump({**MANIFEST, **changes}))
        val = tiny if "truncation_voxels" in changes else None
        with pytest.raises(OcnfError, match=message):
            train(str(path), out, small(levels=1), device="cpu", val=val)
    with pytest.raises(OcnfError, match="needs no meshes"):
        train(tiny, out, small(levels=1), device="cpu", meshes=tmp_path)


@pytest.mark.parametrize(("changes", "message"), [
    ({"variant": "v3"}, r"drawn.yaml: variant: no inputs have that name.*found v3, expected one of v2"),
    ({"encoding": "histogram"}, "drawn.yaml: encoding: .*found histogram, expected one of tsdf, tdf_"),
])
@pytest.mark.parametrize("mixed", [False, True])
def test_inputs_that_a_manifest_lacks_are_said_before_its_validation_set_is_made(
        changes, message, mixed, manifest, small, out) -> None:
    settings = small(levels=1, **changes, **({"mixture": [{}], "samples_per_epoch": 2} if mixed else {}))
    with pytest.raises(OcnfError, match=message) as caught:
        train(manifest, out, settings, device="cpu")
    assert caught.value.code == "missing" and not (out / "validation").exists()


@pytest.mark.parametrize(("part", "message"), [
    ({"data": "MANIFEST", "variant": "v3"}, r"mixture\[1\].variant: it would have no effect: .*found v3"),
    ({"data": "MANIFEST", "meshes": "/nowhere"}, r"mixture\[1\].meshes: .*no mesh files; found /nowhere"),
    ({"data": "VARIANTS", "variant": "v1", "meshes": "/nowhere"}, r"mixture\[1\].meshes: .*no mesh files"),
    ({"variant": "v1", "meshes": "/nowhere"}, r"mixture\[1\].meshes: .*what the command line names"),
])
def test_what_has_no_effect_on_a_part_is_refused_where_a_run_is_begun(
        part, message, manifest, variants, small, out, monkeypatch) -> None:
    named = {"MANIFEST": manifest, "VARIANTS": variants}
    part = part | ({"data": named[part["data"]]} if "data" in part else {})
    settings = small(levels=1, samples_per_epoch=2, variant="v1", mixture=[{"variant": "v2"}, part])
    with pytest.raises(OcnfError, match=message) as caught:
        train(variants, out, settings, device="cpu")
    assert caught.value.code == "manifest" and not out.exists()
    with monkeypatch.context() as patch:
        patch.setattr("ocnf_model.training.data.refuse_idle_part", lambda *arguments: None)
        train(variants, out, settings, device="cpu")
    train(variants, out, settings, device="cpu")  # a run of an earlier version goes on


def made_of(samples: int, failed: int) -> Report:
    """What generation says of a validation set: some samples, and others that could not be made."""
    failures = tuple(Failure(f"m{i}", "val", "chair", f"m{i}.off", "read", "degenerate",
                             "no face\nhas an area") for i in range(failed))
    return Report("out", samples + failed, samples, failures, (), samples, 0, 1.0, 0.25)


@pytest.mark.parametrize(("samples", "failed", "lines"), [
    (40, 1, ["1 of 41 validation samples could not be made",
             "m0.off: degenerate (read): no face has an area"]),
    (40, 9, ["9 of 49 validation samples could not be made", *(f"m{i}.off: degenerate" for i in range(5)),
             "and 4 more"]),
])
def test_validation_samples_that_could_not_be_made_are_named(
        manifest, small, out, monkeypatch, samples, failed, lines) -> None:
    monkeypatch.setattr("ocnf_model.training.making.generate", lambda *_, **__: made_of(samples, failed))
    heard = Console(file=io.StringIO(), width=200)
    settings = small(levels=1)
    open_data(manifest, settings).prepare(out, settings, heard)
    said = heard.file.getvalue().splitlines()[1:]  # after where they are made
    assert len(said) == len(lines)
    assert all(line in found for line, found in zip(lines, said, strict=True))
    assert str(out / "validation" / "failures.jsonl") in said[0]


@pytest.mark.parametrize(("samples", "failed"), [(0, 0), (0, 2), (2, 1)])
def test_a_run_does_not_begin_with_too_few_samples_to_validate_with(
        manifest, small, out, monkeypatch, samples, failed) -> None:
    monkeypatch.setattr("ocnf_model.training.making.generate", lambda *_, **__: made_of(samples, failed))
    settings = small(levels=1)
    message = rf"failures.jsonl.*found {samples} of {samples + failed}.*--val"
    with pytest.raises(OcnfError, match=message) as caught:
        open_data(manifest, settings).prepare(out, settings, Console(quiet=True))
    assert caught.value.code == "too_many_bad"
    out.mkdir()
    (out / "settings.json").write_text("{}")  # one that was begun goes on
    open_data(manifest, settings).prepare(out, settings, Console(quiet=True))


def test_the_command_line_trains_on_a_manifest(manifest, out, tiny) -> None:
    result = CliRunner().invoke(app, [
        "train", manifest, "--out", str(out), "--levels", "1", "--encoding", "tsdf", "--channels", "2,2,2",
        "--epochs", "1", "--workers", "0", "--val", tiny])
    assert result.exit_code == 0, result.output
    assert open_run(out).data.name == "tiny"
