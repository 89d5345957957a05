"""Evaluation and fusing from a run's folder: its resolutions, its truncation, its weights for TV-L1."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest
from ocnf_data.shards.dataset import load_dataset
from ocnf_model import OctNetFusion
from ocnf_model.checkpoint import save_checkpoint
from ocnf_model.evaluation.run import run_choose_weight, run_evaluate
from ocnf_model.header import Architecture, Header, TrainingData
from ocnf_model.scan.run import Asked, run_fuse


def make_run(folder: Path, truncation_voxels: float = 32 / 15) -> Path:
    """One level at 32^3 that finds free space everywhere: what is checked is the way to it."""
    network = OctNetFusion(levels=1, channels=(2, 2, 2))
    for parameter in network.parameters():
        parameter.data.zero_()
    network.levels[0].head.bias.data.fill_(0.5)
    architecture = Architecture(encoding="histogram", join="concat", carry="features", output="tsdf",
                                channels=(2, 2, 2), band=1.0)
    data = TrainingData(name="tiny", checksum="0" * 64, variant="v4", n_train=1, n_val=1, extent=3.0,
                     truncation_voxels=truncation_voxels)
    header = Header(level=1, resolution=32, architecture=architecture, data=data, epoch=1, steps=1,
                    metrics={"mad_mm": 1.0}, settings={}, built_on=None, torch="2")
    save_checkpoint(folder, header, network.levels[0].state_dict())
    return folder


def test_a_run_is_evaluated_at_its_own_resolutions(tiny: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    choices = [{"variant": variant, "resolution": resolution, "weight": 1.0}
               for variant in ("v4", "v2") for resolution in (32, 64)]
    weights = {"schema": 1, "data": load_dataset(tiny).identity, "choices": choices}
    (run / "tvl1.json").write_text(json.dumps(weights))
    found = run_evaluate(str(run), tiny, limit=1, n_figures=0, device="cpu", console=Console(quiet=True))
    assert {(row.method, row.resolution) for row in found.rows if row.variant == "v4"} == {
        ("VolFus", 32), ("VolFus", 64), ("TV-L1", 32), ("TV-L1", 64), ("Ours", 32)}
    assert not any("TV-L1" in note for note in found.notes)
    assert (run / "evaluation" / "test" / "models.csv").exists()
    assert all(row.recall == 0 for row in found.rows if row.method == "Ours")  # it says free everywhere


@pytest.mark.parametrize("data", [{}, {"data": "0" * 64}])
def test_weights_chosen_on_other_data_are_said(data: dict[str, str], tiny: str, tmp_path: Path) -> None:
    """A variant of the same name may be anything."""
    choices = [{"variant": "v2", "resolution": 32, "weight": 1.0}]
    (tmp_path / "kept").mkdir()
    file = tmp_path / "kept" / "tvl1.json"
    file.write_text(json.dumps({"schema": 1, **data, "choices": choices}))
    found = run_evaluate("pretrained", tiny, weights=file, methods=["tvl1"], limit=1, n_figures=0,
                         console=Console(quiet=True))
    said, = (note for note in found.notes if "chosen on this data:" in note)
    assert "for v2 is that of kept/tvl1.json" in said


def test_an_axis_that_cannot_point_up_is_refused(tiny: str) -> None:
    with pytest.raises(OcnfError, match="not an axis that can point up; found x"):
        run_evaluate("pretrained", tiny, methods=["volfus"], up="x")


@pytest.mark.parametrize(("out", "message"), [
    ("file", "file/evaluation.md: a part of the path is a file, not a folder"),
    ("file/new", "a part of the path is a file, not a folder"),
    ("folder", "folder/summary.csv: is a folder, not a file"), ("/proc/new", "/proc/new/evaluation.md: "),
])
def test_where_tables_cannot_be_written_nothing_is_evaluated(tmp_path: Path, out: str, message: str) -> None:
    (tmp_path / "folder" / "summary.csv").mkdir(parents=True)
    (tmp_path / "file").write_text("kept")
    with pytest.raises(OcnfError, match=message):
        run_evaluate("pretrained", str(tmp_path / "no data"), out=tmp_path / out, html=tmp_path / "page.html")
    make_run(tmp_path / "run")
    (tmp_path / "run" / "evaluation").write_text("a file in the way")
    with pytest.raises(OcnfError, match=r"run/evaluation/test/evaluation\.md: a part of the path is a file"):
        run_evaluate(str(tmp_path / "run"), str(tmp_path / "no data"))


@pytest.mark.parametrize(("out", "message"), [
    ("folder", "folder: is a folder, not a file"), ("file/w.json", "a part of the path is a file")])
def test_where_weights_cannot_be_written_none_is_chosen(tmp_path: Path, out: str, message: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("kept")
    with pytest.raises(OcnfError, match=message):
        run_choose_weight(str(tmp_path / "no data"), out=tmp_path / out)


def test_a_run_of_another_truncation_is_refused(tiny: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", truncation_voxels=5.0)
    with pytest.raises(OcnfError, match="truncation_voxels"):
        run_evaluate(str(run), tiny)


def test_fusing_with_a_run(scan: Path, tmp_path: Path) -> None:
    run, out = make_run(tmp_path / "run"), tmp_path / "mesh.ply"
    with pytest.raises(OcnfError, match="no level of this resolution"):
        run_fuse(str(scan), Asked(out, str(run), resolution=64, device="cpu"))
    with pytest.raises(OcnfError, match="no surface was found"):
        run_fuse(str(scan), Asked(out, str(run), device="cpu"))
    assert not out.exists()


def test_a_data_set_of_scans_is_evaluated_on_what_its_frames_know(scan: Path, tmp_path: Path) -> None:
    """VolFus agrees with the reference where no frame has looked; what is free everywhere does not."""
    manifest = Manifest.from_dict({
        "name": "scans", "resolutions": [32],
        "source": {"kind": "sequence", "scans": [scan.name], "configurations": {"test": 2}},
        "inputs": [{"name": "v6", "views": 6, "encodings": ["histogram", "tsdf"]}]})
    assert generate(manifest, tmp_path / "set", scan.parent, progress=False).samples == 2
    run = make_run(tmp_path / "run")
    found = run_evaluate(str(run), str(tmp_path / "set"), methods=["volfus", "ours"], n_figures=0,
                         device="cpu", console=Console(quiet=True), meshes=scan.parent)
    assert len(found.rows) == 4
    for row in found.rows:
        if row.method == "VolFus":
            assert row.regions.unseen_inside < 1e-3 * row.mad_mm < 1e-3 * row.known_mm
        else:
            assert row.regions.unseen_inside > 0.4 * row.mad_mm > 0.4 * row.known_mm
    text = (run / "evaluation" / "test" / "evaluation.md").read_text()
    assert all(f"{one.known_mm:.3f}" in text for one in found.summaries)
