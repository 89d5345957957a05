"""The network against VolFus and TV-L1 on a data set: tables, CSV and the paper's qualitative figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.targets import check_file
from ocnf_data.terminal import check_up
from ocnf_model.checkpoint import SHIPPED, open_run, run_path
from ocnf_model.devices import pick_device
from ocnf_model.evaluation.figure import caption, draw_surfaces
from ocnf_model.evaluation.measure import TRUTH, Bench, MeshArrays, Row, Weight, level_resolutions
from ocnf_model.evaluation.methods import Method, default_weight, parse_methods
from ocnf_model.evaluation.models import DatasetFacts, Models, VariantPlan, plan_variants
from ocnf_model.evaluation.origins import SHAPES, Origins
from ocnf_model.evaluation.summary import Summary, summarise, to_csv
from ocnf_model.evaluation.tables import markdown, print_tables
from ocnf_model.evaluation.weights import read_weights, run_choose_weight
from ocnf_model.measures.regions import EXACT
from ocnf_model.network import OctNetFusion

if TYPE_CHECKING:
    from ocnf_model.evaluation.page import EvaluationPage

__all__ = ["Evaluation", "evaluate", "run_choose_weight", "run_evaluate"]

WEIGHTS_FILE = "tvl1.json"
"""Name of the file in a run's folder that holds TV-L1's weights, if no other file is named."""
_TABLES = ("evaluation.md", "summary.csv", "models.csv")


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        rows: one row for each model, variant, resolution and method.
        summaries: their means, by category and over all.
        notes: what was left out or is approximate, a clause each.
        figures: PNG by file name.
        title: the data set, split and run.
        ceilings: the ground truth of each resolution, measured as a method is: the most that a method of that
            resolution can reach of the true surface.
    """

    rows: list[Row]
    summaries: list[Summary]
    notes: list[str]
    figures: dict[str, bytes]
    title: str
    ceilings: list[Summary] = field(default_factory=list)

    def write(self, out: Path) -> list[Path]:
        """Write `evaluation.md`, `summary.csv`, `models.csv` and the figures into a folder.

        `summary.csv` has the ceilings too, as the method `Ground truth`.
        """
        text = markdown(self.summaries, self.title, self.notes, self.ceilings)
        tables = text, to_csv([*self.summaries, *self.ceilings]), to_csv(self.rows)
        files = {**{name: table.encode() for name, table in zip(_TABLES, tables, strict=True)},
                 **self.figures}
        store = Store(out)
        for name, content in files.items():
            store.put_bytes(name, content)
        return [out / name for name in files]


def run_evaluate(run: str, data: str, *, split: str = "test", out: Path | None = None, device: str = "auto",
                 methods: list[str] | None = None, weights: Path | None = None, limit: int | None = None,
                 n_figures: int = 3, up: str = "z", console: Console | None = None,
                 meshes: Path | None = None, html: Path | None = None) -> Evaluation:
    """Evaluate a run, print the tables and write them.

    Args:
        run: a training run, or `pretrained`; read only where `ours` is among the methods.
        data: a data set, folder or URL.
        split: which split of the data set.
        out: folder for tables and figures; None: RUN/evaluation/SPLIT where RUN is a folder, else
            nothing is written.
        device: where the network runs: auto, cpu, cuda, ...
        methods: `ours`, `volfus`, `tvl1`; None: all that the data set has the inputs for.
        weights: TV-L1's, a file that `run_choose_weight` wrote; None: RUN/tvl1.json if there is one, else
            `DEFAULT_WEIGHTS`, and a note says so.
        limit: the first so many models only.
        n_figures: number of models that are drawn, each of another category.
        up: which axis of the models points up, y or z.
        console: where the tables are printed.
        meshes: the folder that the data set's meshes were read from: surfaces are then measured against the
            meshes themselves. None: against the meshes where they are procedural, else against the surface
            of the finest ground truth.
        html: a page to write, on which every model is shown in 3-D; None for none.

    Raises:
        OcnfError: the tables cannot be written; the data set lacks what a named method needs, or is damaged;
            the run does not fit.
    """
    console = console or Console()
    check_up(up)
    if out is None and run not in SHIPPED and run_path(run).is_dir():
        out = run_path(run) / "evaluation" / split
    if out is not None:
        for name in _TABLES:
            check_file(out / name)
    network, resolutions, page = None, None, None
    if html is not None:
        from ocnf_model.evaluation.page import EvaluationPage

        page = EvaluationPage(html, data, split, meshes, up)
    if methods is None or Method.OURS in methods:
        trained = open_run(run)
        trained.check_truncation(data, DatasetFacts.read(data).truncation_voxels)
        network, resolutions = trained.network.to(pick_device(device)), trained.resolutions
    if weights is None and (kept := run_path(run) / WEIGHTS_FILE).exists():
        weights = kept
    found = evaluate(network, data, resolutions=resolutions, split=split, methods=methods, weights=weights,
                     limit=limit, n_figures=n_figures if out is not None else 0, up=up, console=console,
                     meshes=meshes, page=page,
                     title=f"{data}, {split}" + (f": {run}" if network is not None else ""))
    print_tables(console, found.summaries, found.notes, found.ceilings)
    if out is None:
        console.print("Nothing is written; --out DIR keeps the tables and draws figures.")
    else:
        found.write(out)
        console.print(f"Tables and figures are in {out}", highlight=False, soft_wrap=True)
    if page is not None:
        paths = page.finish(found.title, found.summaries, found.ceilings, found.notes)
        console.print(f"Every model in 3-D: {' and '.join(map(str, paths))}", highlight=False, soft_wrap=True)
    return found


def evaluate(network: OctNetFusion | None, data: str, *, resolutions: Sequence[int] | None = None,
             split: str = "test", methods: Sequence[str] | None = None,
             weights: Path | None = None, limit: int | None = None, n_figures: int = 0, up: str = "z",
             console: Console | None = None, title: str = "", meshes: Path | None = None,
             page: EvaluationPage | None = None, categories: Sequence[str] | None = None) -> Evaluation:
    """Evaluate a network where it is, or the baselines alone.

    Args:
        network: the network, in evaluation mode; None: the baselines alone.
        data: a data set, folder or URL.
        resolutions: resolutions of the network's levels; None: the data set's, from the lowest on.
        split: which split of the data set.
        methods: `ours`, `volfus`, `tvl1`; None: all that the data set has the inputs for.
        weights: file with TV-L1's weights; None: `DEFAULT_WEIGHTS`.
        limit: the first so many models only.
        n_figures: number of models that are drawn.
        up: which axis of the models points up.
        console: where the progress is shown; None shows none.
        title: title of the report.
        meshes: the folder that the data set's meshes were read from, as for `run_evaluate`.
        page: gets every model with its reconstructions; the caller finishes it. None: there is no page.
        categories: models of these only; None for all.

    Raises:
        OcnfError: the network is in training mode or one of completion, or the data set does not fit it.
    """
    if network is not None and not isinstance(network, OctNetFusion):
        raise OcnfError("not a module", field="network", found=type(network).__name__,
                        expected="OctNetFusion", fix="take the `module` of what load_network gives")
    if network is not None and network.training:
        raise OcnfError("the network is in training mode", field="network", fix="call network.eval() first")
    if network is not None:
        network.check_plain(title or "evaluate")
    facts = DatasetFacts.read(data)
    chosen = parse_methods([*Method] if methods is None else methods)
    if network is None and methods is None:
        chosen = tuple(method for method in chosen if method is not Method.OURS)
    read: list[int] = []
    if network is not None and Method.OURS in chosen:
        read = level_resolutions(facts, network, resolutions or facts.resolutions[: len(network.levels)])
    plans, notes = plan_variants(facts, chosen, None if network is None else network.encoding,
                                 required=methods is not None)
    if network is not None and read:
        notes += _has_to_guess(network, read)
    weight = _weights(weights, plans, facts, notes)
    origins = Origins(facts, meshes)
    notes += _measured_against(facts, origins, plans)
    if page is not None:
        page.begin(plans)
    rows: list[Row] = []
    ceilings: list[Row] = []
    figures: dict[str, bytes] = {}
    sets = [Models(facts, split, plan.variant, plan.encodings, facts.resolutions, limit, categories)
            for plan in plans]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=console is None) as progress:
        for plan, models in zip(plans, sets, strict=True):
            task = progress.add_task(plan.variant, total=len(models))
            bench, drawn = Bench(facts, plan, weight, network, read, origins), set[str]()
            for model in models:
                draw = len(drawn) < n_figures and model.category not in drawn
                surfaces: dict[tuple[int, str], MeshArrays] = {}
                captions: dict[tuple[int, str], str] = {}
                results = []
                for result in bench.run(model):
                    (ceilings if result.row.method == TRUTH else rows).append(result.row)
                    if draw:
                        place = result.row.resolution, result.row.method
                        surfaces[place] = result.field.mesh(facts.extent)
                        captions[place] = caption(result.row)
                    if page is not None:
                        results.append(result)
                if page is not None:
                    page.add(model.key, plan.variant, results)
                if draw:
                    drawn.add(model.category)
                    figures[f"{plan.variant}-{model.key}.png"] = draw_surfaces(
                        surfaces, f"{model.key}, {plan.variant}", up, captions)
                progress.advance(task)
    return Evaluation(rows, summarise(rows), notes, figures, title or f"{data}, {split}", summarise(ceilings))


def _has_to_guess(network: OctNetFusion, read: Sequence[int]) -> list[str]:
    """What is said where the network's last level would read one resolution more than the data set has."""
    if network.needs(min(len(read), len(network.levels))) <= len(read):
        return []
    return [f"{Method.OURS.label} at {read[-1]}³ also reads the views at {2 * read[-1]}³, which it has "
            "to guess; it is less exact so: generate the data set with that resolution too"]


def _measured_against(facts: DatasetFacts, origins: Origins, plans: Sequence[VariantPlan]) -> list[str]:
    """Notes on what surfaces and regions are measured by."""
    if origins.available:
        whose = "procedural meshes" if facts.source == SHAPES else "meshes"
        notes = [f"Surfaces are measured against the {whose}, as far as a view of the rig sees them"]
    else:
        notes = [f"Surfaces are measured against that of the ground truth at {max(facts.resolutions)}³; "
                 "--meshes DIR measures against the meshes"]
    for plan in plans:
        if facts.is_occupancy or plan.seen in EXACT or origins.available:
            continue
        if plan.seen is None:
            notes.append(f"{plan.variant} stores no encoding that tells what its views see: no MAD by "
                         "region; --meshes DIR makes the views again")
        else:
            notes.append(f"What the views of {plan.variant} see is read from {plan.seen}, rounded: voxels "
                         "seen just before -tau count as unseen; --meshes DIR makes the views again")
    return notes


def _weights(path: Path | None, plans: Sequence[VariantPlan], facts: DatasetFacts,
             notes: list[str]) -> Weight:
    """TV-L1's weights, with a note on those that nobody chose for this data."""
    known, data = ({}, None) if path is None else read_weights(path)
    variants = [plan.variant for plan in plans if Method.TVL1 in plan.sources]
    wanted = [(variant, resolution) for variant in variants for resolution in facts.resolutions]
    lacking = [f"{variant} at {resolution}³" for variant, resolution in wanted
               if (variant, resolution) not in known]
    if lacking:
        notes.append(f"TV-L1's weight is the package's default for {', '.join(lacking)}, not one chosen on "
                     "this data's validation split")
    given = list(dict.fromkeys(variant for variant, resolution in wanted if (variant, resolution) in known))
    if path is not None and given and data != facts.identity:
        notes.append(f"TV-L1's weight for {', '.join(given)} is that of {path.parent.name}/{path.name}, not "
                     "chosen on this data: `ocnf-model choose-weight` does that")
    return lambda variant, resolution: known.get((variant, resolution), default_weight(resolution))
