"""Many runs at once: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Final

from rthyb_rt.campaign.one_run import OtherProgramError, carry_out
from rthyb_rt.campaign.plan import FAILED, PlannedRun, Row, program
from rthyb_rt.errors import InputError

ONE_THREAD: Final = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
"""Each process has one processor, which threads of a linear algebra library would share."""
AHEAD: Final = 4
"""Runs that are queued for each process, so that none is ever idle; not tuned."""

Done = Callable[[Row], None]


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let processes that are created in the block compute with one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _begin() -> None:
    """Leave Ctrl-C to the conducting process, and end with it, however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    conducting = multiprocessing.parent_process()
    if conducting is not None:
        threading.Thread(target=_end_after, args=(conducting,), daemon=True).start()


def _end_after(conducting: BaseProcess) -> None:
    """Wait until another process is no more, then end this one in the middle of what it does.

    After SIGKILL or SIGTERM nobody tells the processes of a pool; they would wait for a next run
    forever.
    """
    conducting.join()
    os._exit(1)


@contextmanager
def _no_main() -> Iterator[None]:
    """Prevent processes that are created in the block from importing the caller's main module.

    Otherwise they would run a user's script from its beginning, including its sweep, unless it is
    guarded by ``__name__``; a run needs nothing from it.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


@contextmanager
def workers(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes with one thread each; waiting runs are dropped at the end."""
    # New processes inherit no open files and no locks held by threads of this one.
    context = multiprocessing.get_context("spawn")
    with single_threaded(), _no_main():
        pool = ProcessPoolExecutor(jobs, context, initializer=_begin)
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def locally(cases: Sequence[PlannedRun], jobs: int, keep: str, folder: str, done: Done) -> None:
    """Carry out runs in processes of this machine.

    If a process dies, the runs that it may have had are repeated one at a time; a run whose process
    dies again gets a row that says so.

    Args:
        cases: the runs.
        jobs: number of processes.
        keep, folder: as for `carry_out`.
        done: called with each row, in this process, in any order.

    Raises:
        InputError: a process has another core than this one: its sources were changed meanwhile.
    """
    suspects = _spread(list(cases), jobs, keep, folder, done)
    for case in suspects:
        if _spread([case], 1, keep, folder, done):
            done(case.identity() | {"ending": FAILED, "cause": "its process was terminated twice"})


def _spread(
    cases: list[PlannedRun], jobs: int, keep: str, folder: str, done: Done
) -> list[PlannedRun]:
    """Carry out runs; return those that were under way when a process died, and all later ones.

    After such a death, the rest continues in new processes.
    """
    suspects: list[PlannedRun] = []
    waiting = cases[::-1]
    while waiting:
        under_way: dict[Future[Row], PlannedRun] = {}
        with workers(min(jobs, len(waiting))) as pool:
            try:
                while waiting or under_way:
                    while waiting and len(under_way) < AHEAD * jobs:
                        # A pool whose process has died refuses: the run stays in the queue.
                        future = pool.submit(carry_out, waiting[-1], keep, folder, program())
                        under_way[future] = waiting.pop()
                    ready, _ = wait(under_way, return_when=FIRST_COMPLETED)
                    for future in ready:
                        done(future.result())
                        del under_way[future]
            except BrokenProcessPool:
                suspects += _undone(under_way, done)
    return suspects


def _undone(under_way: dict[Future[Row], PlannedRun], done: Done) -> list[PlannedRun]:
    """Store the runs that were completed when a process died; return the others."""
    left = []
    for future, case in under_way.items():
        if future.done() and not future.cancelled() and future.exception() is None:
            done(future.result())
        else:
            left.append(case)
    return left


def on_cluster(
    cases: Sequence[PlannedRun], cluster: Any, keep: str, folder: str, done: Done
) -> None:
    """Carry out runs on a Dask cluster; arguments as for `locally`.

    If a worker dies, the scheduler gives its runs to others. Kept recordings go to the campaign's
    folder, which the workers must be able to access under the same path. All of them must have the
    same program as this process: control laws are compiled into its core, including those that a
    laboratory has added.

    Args:
        cluster: address of the scheduler, ``tcp://HOST:8786``, or a `distributed.Client`, which
            stays open.

    Raises:
        InputError: the package distributed is not installed, nobody answers, or a worker has
            another program.
    """
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            f"--cluster needs {error.name}; install it with pip install 'rthyb-rt[cluster]'"
        ) from error
    with _client(distributed, cluster) as client:
        address = client.scheduler.address
        cores = sum(client.ncores().values())
        if not cores:
            raise InputError("the cluster has no workers; start some: dask worker ADDRESS", address)
        ours = program()
        _require_same_program(client, ours, address)
        waiting = list(cases)[::-1]
        of: dict[str, PlannedRun] = {}

        def next_one() -> Any:
            case = waiting.pop()
            future = client.submit(carry_out, case, keep, folder, ours, pure=False)
            of[future.key] = case
            return future

        first = [next_one() for _ in range(min(AHEAD * cores, len(waiting)))]
        arriving = distributed.as_completed(first)
        for future in arriving:
            case = of.pop(future.key)
            if future.status == "error":
                if isinstance(future.exception(), OtherProgramError):  # one that came later
                    raise future.exception()
                done(case.identity() | {"ending": FAILED, "cause": _why(future.exception())})
            else:
                done(future.result())
            future.release()
            if waiting:
                arriving.add(next_one())


def _client(distributed: Any, cluster: Any) -> AbstractContextManager[Any]:
    """Return a client of a cluster: the given one, or a new one for the time of the block.

    Raises:
        InputError: no scheduler answers at the address.
    """
    if not isinstance(cluster, str):
        return nullcontext(cluster)
    try:
        client: AbstractContextManager[Any] = distributed.Client(cluster, timeout=10)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers ({error}); start one with: dask scheduler", cluster
        ) from error
    return client


def _require_same_program(client: Any, ours: str, address: str) -> None:
    """Refuse workers whose results would differ.

    Raises:
        InputError: with their addresses.
    """
    found = client.run(program, on_error="return")
    others = {worker: has for worker, has in found.items() if has != ours}
    if others:
        differing = "; ".join(
            f"{worker}: {has if isinstance(has, str) else type(has).__name__ + f': {has}'}"
            for worker, has in sorted(others.items())
        )
        raise InputError(
            "not every worker has the same rthyb_rt and the same control laws as this process "
            f"(here: {ours}; workers that differ: {differing}); install the same sources on every "
            "machine",
            address,
        )


def _why(error: BaseException | None) -> str:
    name = type(error).__name__
    return "its worker was terminated repeatedly" if name == "KilledWorker" else f"{name}: {error}"
