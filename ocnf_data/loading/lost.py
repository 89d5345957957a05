"""Samples of an epoch that could not be had: counted by all worker processes together, and bounded."""

from __future__ import annotations

import logging
import multiprocessing

import numpy as np

from ocnf_data.errors import OcnfError


class LostSamples:
    """Which samples were lost in which epoch. Travels to workers by fork or spawn; copies share one memory.

    Args:
        n_samples: samples that there are.
        limit: how many of them may be lost in one epoch.
        what: what is lost, in the plural, for messages.
        where: who says so.
        fix: what to do about too many.
        logger: that each loss is logged to, once an epoch.
    """

    def __init__(self, n_samples: int, limit: int, what: str, where: str, fix: str, logger: str) -> None:
        self._limit, self._what, self._where, self._fix, self._logger = limit, what, where, fix, logger
        # Last epoch, counted from 1, in which each sample was lost. Workers write without a lock: two that
        # lose the same sample write the same number. Of a spawn context, which works under fork too.
        self._lost_in = multiprocessing.get_context("spawn").RawArray("q", n_samples)

    def count(self, sample: int, epoch: int, message: str, error: OcnfError) -> None:
        """Write a loss down.

        Args:
            sample: its number.
            epoch: in which it was lost.
            message: for the log.
            error: why.

        Raises:
            OcnfError: code `too_many_bad`.
        """
        lost_in = np.frombuffer(self._lost_in, np.int64)
        if lost_in[sample] != epoch + 1:
            lost_in[sample] = epoch + 1
            logging.getLogger(self._logger).warning("%s", message)
        count = int((lost_in == epoch + 1).sum())
        if count > self._limit:
            raise OcnfError(f"too many {self._what} in one epoch", code="too_many_bad", where=self._where,
                            field="max_bad_fraction", found=f"{count}, the last: {error}",
                            expected=f"at most {self._limit}", fix=self._fix) from None

    def of(self, epoch: int) -> list[int]:
        """Numbers of the samples that were lost in an epoch, unless a later one lost them again."""
        found: list[int] = np.flatnonzero(np.frombuffer(self._lost_in, np.int64) == epoch + 1).tolist()
        return found
