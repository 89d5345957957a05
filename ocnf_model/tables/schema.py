"""What a table of the paper is, as a YAML file: its inputs, networks, rows, columns and the paper's figures.

The files lie beside this module, one a table. A cell's figure is found by what its row and its column say
together: which method, on which input, by which network, at which level, over which category.

>>> table = load_table("views")
>>> table.rows[2].name, table.columns[2].name, table.rows[2].paper[2]
('4 views', 'Ours', 0.337)
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.strict_yaml import read_yaml
from ocnf_data.files.validation import Int, NotEmpty, Positive, Real, Strict, refused, validate
from ocnf_model.evaluation.methods import Method

TABLE_NAMES = ("encodings", "views", "noise", "unseen", "kinect", "completion", "runtime")
"""All tables, in the paper's order."""
PAPER_CATEGORIES = ("airplane", "bed", "car", "desk", "chair", "guitar", "piano", "person", "toilet")
"""The paper's categories, as far as they are known: its list names piano twice, and the tenth is unknown."""
_FOLDER = Path(__file__).parent


class Quantity(StrEnum):
    """What the figures of a table are."""

    MAD = "mad"
    """Mean absolute distance over all voxels of the cube, millimetres: the mean over the models."""
    SECONDS = "seconds"
    """Time from the depth maps to the reconstruction, the input's encoding included: the median."""
    OVERLAP = "overlap"
    """Intersection over union, precision and recall of what is occupied."""


class Pipeline(StrEnum):
    """What makes the figures of a table."""

    SAMPLES = "samples"
    """Data sets of noisy views of meshes, networks trained on them, and their evaluation."""
    SCANS = "scans"
    """The same, from depth sequences of a real sensor."""
    COMPLETION = "completion"
    """Completion of a scene from one view."""


class InputSpec(Strict):
    """Views of a model, fused: one variant of a data set's inputs."""

    views: Positive
    """Views of the rig."""
    sigma: Annotated[Real, Field(ge=0, le=1)]
    """Standard deviation of the noise, as a fraction of the depth."""
    encodings: Annotated[tuple[Encoding, ...], NotEmpty]
    """How the views are written into octrees."""


class NetworkSpec(Strict):
    """A network that the table needs."""

    input: str
    """The input that it is trained and tested on, one of the table's `inputs`."""
    encoding: Encoding
    """The input's encoding."""
    without: tuple[str, ...] = ()
    """Categories that it does not see in training, by the paper's names."""

    @property
    def name(self) -> str:
        """A name that says all of it, the same in every table."""
        left_out = f"-without-{'-'.join(self.without)}" if self.without else ""
        return f"{self.encoding}-{self.input}{left_out}"


class Line(Strict):
    """A row or a column; what a row leaves open, its column says."""

    label: str
    """The heading, as plain text."""
    latex: str | None = None
    """The heading in LaTeX; None for the label."""
    group: str | None = None
    """The heading that it shares with the lines beside it."""
    group_latex: str | None = None
    """That heading in LaTeX; None for the group's own."""
    method: Method | None = None
    """The method whose figures these are."""
    input: str | None = None
    """The input that they are on; None for the network's own."""
    network: str | None = None
    """The network, where the method is `ours`."""
    level: Annotated[Int, Field(ge=1, le=3)] | None = None
    """The level of the resolution, from 1: the paper's 64^3, 128^3, 256^3. None for the finest."""
    category: str | None = None
    """The category of the models; None for all."""
    completion: str | None = None
    """A row's method of completion, by the name that `ocnf-model complete evaluate` gives it."""
    score: Literal["iou", "precision", "recall"] | None = None
    """The score of completion that a column has."""

    @property
    def name(self) -> str:
        """Group and label."""
        return self.label if self.group is None else f"{self.group} {self.label}"


class PaperRow(Line):
    """A row with the paper's figures."""

    paper: tuple[Real | None, ...]
    """The paper's figures, a column each; None where it has none."""


class Claim(Strict):
    """What the paper reads out of the table: some figures are less than others."""

    says: str
    """The claim, a sentence."""
    along: Literal["columns", "rows"] = "columns"
    """Whether columns of a row are compared, or rows of a column."""
    less: str
    """The line with the lesser figures, by name."""
    than: Annotated[tuple[str, ...], NotEmpty]
    """The lines with the greater ones."""
    less_from: str | None = None
    """Compare increases: the line that `less` has increased from."""
    than_from: tuple[str, ...] = ()
    """The lines that those of `than` have increased from, one each."""
    only: tuple[str, ...] | None = None
    """Names of the lines of the other kind that the claim is about; None for all."""


class TableSpec(Strict):
    """A table of the paper."""

    name: str
    """What the command line calls it."""
    title: str
    """The paper's caption."""
    quantity: Quantity
    """What its figures are."""
    unit: str
    """Their unit, as it stands in the caption; empty for none."""
    pipeline: Pipeline = Pipeline.SAMPLES
    """What makes the figures."""
    digits: Int = 3
    """Digits after the point."""
    corner: str = ""
    """Heading of the column of the rows' labels."""
    protocol: str
    """The paper's data and training, in a sentence."""
    remarks: tuple[str, ...] = ()
    """What is always different here, a sentence each."""
    figures: tuple[str, ...] = ()
    """Categories of which the first test model is drawn, by the paper's names."""
    inputs: Mapping[str, InputSpec] = Field(default_factory=dict)
    """What the methods get to see, by name; a name means the same in every table."""
    networks: Mapping[str, NetworkSpec] = Field(default_factory=dict)
    """The networks, by name within the table."""
    columns: Annotated[tuple[Line, ...], NotEmpty]
    """The columns, left to right."""
    rows: Annotated[tuple[PaperRow, ...], NotEmpty]
    """The rows, top to bottom."""
    claims: tuple[Claim, ...] = ()
    """What the paper reads out of it."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for i, row in enumerate(self.rows):
            if len(row.paper) != len(self.columns):
                raise refused("not a figure for each column", at=f"rows[{i}].paper", found=len(row.paper),
                              expected=str(len(self.columns)))
        for line in (*self.columns, *self.rows):
            for kind, name, known in (("input", line.input, self.inputs),
                                      ("network", line.network, self.networks)):
                if name is not None and name not in known:
                    raise refused(f"no such {kind}", found=name, expected=", ".join(known))
        for name, network in self.networks.items():
            if network.input not in self.inputs:
                raise refused("no such input", at=f"networks.{name}.input", found=network.input)
            if network.encoding not in self.inputs[network.input].encodings:
                raise refused("the input has no such encoding", at=f"networks.{name}.encoding",
                              found=network.encoding)
        for i, claim in enumerate(self.claims):
            lines, others = self.axes(claim)
            named = [claim.less, *claim.than, *claim.than_from,
                     *([] if claim.less_from is None else [claim.less_from])]
            for name in (*named, *(claim.only or ())):
                if name not in {line.name for line in (lines if name in named else others)}:
                    raise refused("no such line", at=f"claims[{i}]", found=name)
            if claim.less_from is not None and len(claim.than_from) != len(claim.than):
                raise refused("not a line for each of `than`", at=f"claims[{i}].than_from")
        return self

    def axes(self, claim: Claim) -> tuple[tuple[Line, ...], tuple[Line, ...]]:
        """The lines that a claim compares, and the lines of the other kind."""
        return (self.columns, self.rows) if claim.along == "columns" else (self.rows, self.columns)

    @property
    def needed(self) -> tuple[str, ...]:
        """Categories that the table cannot do without, by the paper's names, in the order it names them."""
        named = [row.category for row in self.rows if row.category is not None]
        left_out = [one for network in self.networks.values() for one in network.without]
        return tuple(dict.fromkeys([*named, *left_out]))


@cache
def load_table(name: str) -> TableSpec:
    """The table of that name.

    Raises:
        OcnfError: there is none.
    """
    if name not in TABLE_NAMES:
        raise OcnfError("no such table", field="NAME", found=name, expected=", ".join((*TABLE_NAMES, "all")))
    path = _FOLDER / f"{name}.yaml"
    return validate(TableSpec, read_yaml(path), path)


def all_encodings(variant: str) -> tuple[Encoding, ...]:
    """Every encoding that any table wants of an input, so that one data set serves all tables."""
    specs = [spec for table in map(load_table, TABLE_NAMES) for name, spec in table.inputs.items()
             if name == variant]
    wanted = {encoding for spec in specs for encoding in spec.encodings}
    return tuple(encoding for encoding in Encoding if encoding in wanted)
