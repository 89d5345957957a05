"""Beside other processes: threads do not spin while they wait, and workers take one core each."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
from torch.utils.data import DataLoader, Dataset

from ocnf_model.training.stage import _report_unless_hung_up, use_one_thread


class _Threads(Dataset[int]):
    """How many threads numba has where an item is made."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, _: int) -> int:
        return int(numba.get_num_threads())


def test_a_loaders_worker_has_one_thread() -> None:
    loader = DataLoader(_Threads(), batch_size=None, num_workers=2, worker_init_fn=use_one_thread)
    assert list(loader) == [1, 1]


def test_the_command_line_lets_openmp_wait_without_spinning() -> None:
    """It has to be said before PyTorch loads OpenMP; what the user says goes before it."""
    code = ("import os, sys\nfrom ocnf_model import cli\nassert 'torch' not in sys.modules\n"
            "cli.run_app = lambda *_: print(os.environ['OMP_WAIT_POLICY'])\ncli.main()")
    for said, expected in ((None, "PASSIVE"), ("ACTIVE", "ACTIVE")):
        environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        environment |= {} if said is None else {"OMP_WAIT_POLICY": said}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
        assert done.stdout.strip() == expected, done.stderr


def test_a_worker_says_nothing_of_a_connection_that_ends(capsys) -> None:
    for error in (EOFError(), ConnectionResetError(104, "Connection reset by peer"), FileNotFoundError()):
        _report_unless_hung_up(type(error), error, None)
    assert capsys.readouterr().err == ""
    _report_unless_hung_up(ValueError, ValueError("of its own"), None)
    assert capsys.readouterr().err == "ValueError: of its own\n"
