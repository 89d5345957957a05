"""Make a verified data set, pictures and reconstructions from nothing: what `make demo` runs.

python tools/demo.py --out demo-out                  procedural shapes
python tools/demo.py --out demo-out --meshes DIR     24 of the meshes in a folder of your own
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.generation import generate
from ocnf_data.inspection.choose import pick
from ocnf_data.inspection.show import draw_sample
from ocnf_data.inspection.stats import collect, draw, print_table
from ocnf_data.manifest import Manifest, load_manifest
from ocnf_data.report.run import write_report
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.terminal import print_error
from ocnf_data.verify.problems import print_verify
from ocnf_data.verify.summary import describe, print_summary
from ocnf_data.verify.verify import verify
from ocnf_model.checkpoint import PRETRAINED
from ocnf_model.evaluation.run import run_evaluate

MANIFESTS = Path(__file__).parent.parent / "manifests"
MOST_MESHES = 24
N_RECONSTRUCTED = 4


def demo_manifest(meshes: Path | None) -> Manifest:
    """The shipped demo, or the first meshes of a folder made the same way."""
    if meshes is None:
        return load_manifest(MANIFESTS / "demo.yaml")
    settings = load_manifest(MANIFESTS / "meshes.yaml").to_dict()
    settings["source"]["at_most"] = MOST_MESHES
    settings["shards"]["samples"] = 4
    settings["inputs"][0]["encodings"].append("tsdf")  # VolFus, exactly
    return Manifest.from_dict(settings)


def main(
    out: Annotated[Path, typer.Option(help="Folder for the data set and its pictures.")] = Path("demo-out"),
    meshes: Annotated[Path | None, typer.Option(help="Your own folder of meshes.")] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    up: Annotated[str, typer.Option(help="Which axis of the meshes points up: y or z.")] = "z",
) -> None:
    """Generate the demo data set, verify it, draw pictures, and reconstruct it with the shipped network."""
    console = Console()
    begin = time.perf_counter()
    pages: list[Path] = []

    def step(title: str) -> None:
        console.print(f"\n[bold]{title}[/]")

    try:
        manifest = demo_manifest(meshes)
        data = out / manifest.name
        step(f"1. Generate: ocnf-data generate manifests/{manifest.name}.yaml --out {data} --jobs {jobs}")
        report = generate(manifest, data, meshes, jobs)
        console.print(report.table())
        if not report.samples:
            raise OcnfError("no sample came out", where=data, fix="read failures.jsonl there")
        step(f"2. Verify every byte: ocnf-data verify {data}")
        status = print_verify(verify(str(data)), console)
        if status:
            raise typer.Exit(status)
        step(f"3. What is in it: ocnf-data info {data}")
        print_summary(describe(str(data)), console)
        step(f"4. Statistics by category: ocnf-data stats {data}")
        columns = collect(str(data), None, 1)
        print_table(columns, console)
        draw(columns, out / "pictures" / "statistics.png")
        step(f"5. Pictures: ocnf-data show {data}")
        for sample in [*pick(str(data), [], 0, 0), *pick(str(data), [], 3, seed=1)]:
            path = out / "pictures" / f"{sample.key}.png"
            if not path.exists():
                draw_sample(sample, manifest, path, meshes, up=up)
                console.print(f"   {path}")
        pictures = out / "pictures" / "reconstructions"
        step(f"6. The shipped network beside its baselines, on {N_RECONSTRUCTED} models: ocnf-model evaluate "
             f"pretrained {data} --out {pictures} --html {out / 'reconstructions.html'}")
        if "test" not in load_dataset(str(data)).splits:
            console.print("   chance put none of the meshes into the test split")
        else:
            run_evaluate(PRETRAINED, str(data), out=pictures, limit=N_RECONSTRUCTED, n_figures=2, up=up,
                         console=console, html=out / "reconstructions.html")
            pages.append(out / "reconstructions.html")
        step(f"7. A page to look at: ocnf-data report {data} --out {out / 'report.html'}")
        write_report(str(data), out / "report.html", meshes=meshes, up=up, jobs=jobs)
        pages.append(out / "report.html")
    except OcnfError as error:
        print_error(str(error), Console(stderr=True))
        raise typer.Exit(1) from None
    console.print(f"\n[green]Done in {time.perf_counter() - begin:.0f} s.[/] Look at {out / 'pictures'}; "
                  f"check the physics with: ocnf-data check {data}"
                  + (f" --meshes {meshes}" if meshes else ""))
    console.print("Open in a browser:", *(page.resolve().as_uri() for page in pages), sep="\n   ",
                  highlight=False, markup=False, soft_wrap=True)


if __name__ == "__main__":
    typer.run(main)
