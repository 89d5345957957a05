"""The declarations: complete, of one meaning, and the paper's figures agree where tables share them."""

from __future__ import annotations

from collections import defaultdict

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.validation import validate
from ocnf_model.tables.schema import TABLE_NAMES, TableSpec, load_table
from ocnf_model.tables.steps import input_of, network_of

ALL = {name: load_table(name) for name in TABLE_NAMES}


@pytest.mark.parametrize("table", ALL.values(), ids=ALL)
def test_every_cell_of_a_table_that_can_be_made_says_what_it_is(table: TableSpec) -> None:
    if table.pipeline == "completion":
        assert all(column.score for column in table.columns)
        assert sum(row.completion is None for row in table.rows) == 1  # what the authors could not repeat
        return
    used = set()
    for row in table.rows:
        for column in table.columns:
            method = row.method or column.method
            assert method is not None and input_of(table, row, column) is not None
            network = network_of(table, row, column)
            assert (network is None) == (method != "ours")
            used.add(network)
    assert set(table.networks.values()) <= used


def test_a_name_of_an_input_means_the_same_in_every_table() -> None:
    meanings = defaultdict(set)
    for table in ALL.values():
        for name, spec in table.inputs.items() if table.pipeline == "samples" else ():
            meanings[name].add((spec.views, spec.sigma))
    assert all(len(found) == 1 for found in meanings.values())
    assert all(name == f"v{views}_n{round(100 * sigma):02d}"
               for name, found in meanings.items() for views, sigma in found)


def test_figures_that_the_paper_prints_in_several_tables_are_the_same() -> None:
    printed = defaultdict(set)
    for table in ALL.values():
        for row in table.rows:
            for column, figure in zip(table.columns, row.paper, strict=True):
                if table.pipeline == "samples" and table.quantity == "mad" and figure is not None:
                    network = network_of(table, row, column)
                    cell = (row.method or column.method, input_of(table, row, column),
                            None if network is None else network.name, row.level or 3, row.category)
                    printed[cell].add(figure)
    assert all(len(figures) == 1 for figures in printed.values())
    assert len(printed) < sum(len(table.rows) * len(table.columns) for table in ALL.values()
                              if table.pipeline == "samples" and table.quantity == "mad")


@pytest.mark.parametrize(("change", "said"), [
    ({"rows": [{"label": "64³", "paper": [1.0]}]}, "not a figure for each column"),
    ({"claims": [{"says": "x", "less": "Ours", "than": ["nobody"]}]}, "no such line"),
    ({"inputs": {"v9_n02": {"views": 9, "sigma": 0.02, "encodings": ["tsdf"]}}}, "no such input"),
    ({"networks": {}}, "no such network"),
])
def test_a_declaration_that_contradicts_itself_is_refused(change: dict[str, object], said: str) -> None:
    fields = ALL["views"].model_dump(mode="json")
    validate(TableSpec, fields, "views")
    with pytest.raises(OcnfError, match=said):
        validate(TableSpec, {**fields, **change}, "views")


def test_an_unknown_table_is_named() -> None:
    with pytest.raises(OcnfError, match="no such table; found figures, expected encodings"):
        load_table("figures")
