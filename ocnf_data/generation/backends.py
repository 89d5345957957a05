"""Where shards are made: in this process, in local processes (joblib's loky), on a Dask or a Ray cluster.

A backend is a generator from tasks to finished shards, in any order. Closing it, which leaving the loop
does, ends what it started; on an error or Ctrl-C that does not wait for shards in the making.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Sequence
from typing import Any

from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.interrupts import ignore_interrupts, joblib_results
from ocnf_data.generation.shard_task import ShardDone, ShardTask, make_shard
from ocnf_data.generation.worker.supervisor import close_supervisor_of_this_thread

Finished = Generator[ShardDone, None, None]
# A worker process (not the child its items run in) that dies, of the out-of-memory killer say, costs its
# shards a new try; this many deaths with nothing finished in between end the run.
_MAX_DEATHS = 3
_WATCH_SECONDS = 0.5
_LOGS = "look at the workers' logs: it is mostly memory that runs out"


def run_tasks(tasks: Sequence[ShardTask], jobs: int, backend: str) -> Finished:
    """Make all shards, yielding each when it is in its place.

    Args:
        tasks: the shards to make.
        jobs: worker processes; one loky job runs in this process. A cluster named by DASK_SCHEDULER_ADDRESS
            or RAY_ADDRESS has the workers it has.
        backend: a name from `BACKENDS`.

    Raises:
        OcnfError: what a shard raised; the shards finished before are in their places.
    """
    if backend not in BACKENDS:
        raise OcnfError("unknown backend", field="backend", found=backend, expected=" or ".join(BACKENDS))
    if not tasks:
        return
    serial = backend == "loky" and jobs == 1
    yield from _serial(tasks, jobs) if serial else BACKENDS[backend](tasks, jobs)


def _serial(tasks: Sequence[ShardTask], jobs: int) -> Finished:
    try:
        for task in tasks:
            yield make_shard(task)
    finally:
        close_supervisor_of_this_thread()


def _loky(tasks: Sequence[ShardTask], jobs: int) -> Finished:
    with _needs("joblib", "generate"):
        from joblib import Parallel, delayed
        from joblib.externals.loky import get_reusable_executor
        from joblib.externals.loky.process_executor import BrokenProcessPool
    left = {task.shard.name: task for task in tasks}
    deaths = 0
    finished = False
    try:
        while left:
            # With a single job joblib would work in this process.
            parallel = Parallel(n_jobs=max(2, min(jobs, len(left))), backend="loky", batch_size=1,
                                pre_dispatch="2*n_jobs", max_nbytes=None, return_as="generator_unordered")
            calls = [delayed(_shard_or_error)(task, os.getpid()) for task in left.values()]
            try:
                with joblib_results(functools.partial(parallel, calls)) as results:
                    for result in results:
                        done = _raised(result)
                        del left[done.name]
                        deaths = 0
                        yield done
            except BrokenProcessPool as error:
                deaths += 1
                if deaths >= _MAX_DEATHS:
                    raise OcnfError(f"worker processes keep dying ({type(error).__name__})", code="workers",
                                    fix="run with fewer --jobs: it is mostly memory that runs out") from error
        finished = True
    finally:
        # Not `reuse="auto"`: replacing the executor would wait for the shards in the making.
        get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=not finished)


def _dask(tasks: Sequence[ShardTask], jobs: int) -> Finished:
    with _needs("dask", "cluster"):
        from distributed import Client, LocalCluster, as_completed
        from distributed.scheduler import KilledWorker
    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    with contextlib.ExitStack() as stack:
        if address is None:
            # Memory is the operating system's to limit: Dask counts a worker's own, not its child's.
            address = stack.enter_context(LocalCluster(n_workers=jobs, threads_per_worker=1, memory_limit=0,
                                                       dashboard_address=None))
        client = stack.enter_context(Client(address))
        futures = client.map(_shard_or_error, tasks, driver=os.getpid(), pure=False)
        try:
            for future in as_completed(futures):
                try:
                    result = future.result()
                except KilledWorker as error:
                    raise OcnfError(f"a Dask worker died again and again: {error}", code="workers",
                                    fix=_LOGS) from error
                yield _raised(result)
                future.release()
        finally:
            client.cancel(futures)


def _ray(tasks: Sequence[ShardTask], jobs: int) -> Finished:
    with _needs("ray", "cluster"):
        import ray
    started = not ray.is_initialized()
    if started:
        here: dict[str, Any] = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": jobs}
        ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR, **here)
    make = ray.remote(num_cpus=1, max_retries=_MAX_DEATHS)(_shard_or_error)
    waiting = [make.remote(task, os.getpid()) for task in tasks]
    try:
        while waiting:
            ready, waiting = ray.wait(waiting, num_returns=1)
            try:
                result = ray.get(ready[0])
            except ray.exceptions.WorkerCrashedError as error:
                raise OcnfError(f"a Ray worker died again and again: {error}", code="workers",
                                fix=_LOGS) from error
            yield _raised(result)
    finally:
        for task in waiting:
            ray.cancel(task, force=True)
        if started:
            ray.shutdown()


BACKENDS: dict[str, Callable[[Sequence[ShardTask], int], Finished]] = {
    "loky": _loky,
    "dask": _dask,
    "ray": _ray,
}


def _shard_or_error(task: ShardTask, driver: int) -> ShardDone | OcnfError:
    """Run a task in a worker; errors go back as values, because each backend wraps exceptions differently."""
    if os.getpid() != driver and threading.current_thread() is threading.main_thread():
        ignore_interrupts()  # the driver decides what becomes of the workers
        if os.getppid() == driver:  # loky; clusters look after their workers themselves
            _end_with(driver)
    try:
        return make_shard(task)
    except OcnfError as error:
        return error


@functools.cache
def _end_with(driver: int) -> None:
    """End this worker when its driver is killed: what it goes on with could land in a later run's folder.

    Not by the system's signal on a parent's death, which comes when the *thread* that started us ends.
    """

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(_WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, name="watch the driver", daemon=True).start()


def _raised(result: ShardDone | OcnfError) -> ShardDone:
    if isinstance(result, OcnfError):
        raise result
    return result


@contextlib.contextmanager
def _needs(library: str, extra: str) -> Generator[None, None, None]:
    try:
        yield
    except ImportError as error:
        raise missing_extra(f"{library} is not installed", extra) from error
