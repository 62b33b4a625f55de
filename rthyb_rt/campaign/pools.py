"""Many runs at once: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import ModuleType
from typing import Any, Final

from rthyb_rt.campaign.plan import FAILED, Case, Row, program
from rthyb_rt.campaign.running import OtherProgramError, carry_out
from rthyb_rt.errors import InputError

ONE_THREAD: Final = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
"""Each process has one processor: threads of a linear algebra library would share it."""
AHEAD: Final = 4
"""Runs that wait for each process, so that none is ever idle; numerics, not tuned."""

Done = Callable[[Row], None]


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def single_threaded() -> Iterator[None]:
    """Have the processes that are made inside the block compute with one thread each."""
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


def _leave_interrupts() -> None:
    """Leave Ctrl-C to the process that conducts, which ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _no_main() -> Iterator[None]:
    """Have the processes that are made inside the block import nothing of whoever calls.

    They would run a user's script from its top otherwise, sweep and all, unless it is guarded by
    its ``__name__``; and a run needs nothing of it.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


@contextmanager
def workers(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of so many processes of one thread each; what waits at the end is dropped."""
    # Fresh processes: nothing that this one has open, no lock that one of its threads holds.
    context = multiprocessing.get_context("spawn")
    with single_threaded(), _no_main():
        pool = ProcessPoolExecutor(jobs, context, initializer=_leave_interrupts)
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def locally(cases: Sequence[Case], jobs: int, keep: str, folder: str, done: Done) -> None:
    """Carry out runs in processes of this machine.

    A process that dies takes no run with it: those that it may have had are tried again, one at a
    time, and one whose process dies once more is a row that says so.

    Args:
        cases: the runs.
        jobs: processes.
        keep, folder: as `carry_out` takes them.
        done: takes each row, in this process, in no order.

    Raises:
        InputError: a process has another core than this one: its sources were changed meanwhile.
    """
    suspects = _spread(list(cases), jobs, keep, folder, done)
    for case in suspects:
        if _spread([case], 1, keep, folder, done):
            done(case.identity() | {"ending": FAILED, "cause": "its process was terminated twice"})


def _spread(cases: list[Case], jobs: int, keep: str, folder: str, done: Done) -> list[Case]:
    """Carry out runs; return those that were under way when a process died, and all behind them.

    Behind such a death the rest goes on in new processes.
    """
    suspects: list[Case] = []
    waiting = cases[::-1]
    while waiting:
        under_way: dict[Future[Row], Case] = {}
        with workers(min(jobs, len(waiting))) as pool:
            try:
                while waiting or under_way:
                    while waiting and len(under_way) < AHEAD * jobs:
                        case = waiting.pop()
                        under_way[pool.submit(carry_out, case, keep, folder, program())] = case
                    ready, _ = wait(under_way, return_when=FIRST_COMPLETED)
                    for future in ready:
                        done(future.result())
                        del under_way[future]
            except BrokenProcessPool:
                suspects += _undone(under_way, done)
    return suspects


def _undone(under_way: dict[Future[Row], Case], done: Done) -> list[Case]:
    """Keep what had come to its end when a process died; return the others."""
    left = []
    for future, case in under_way.items():
        if future.done() and not future.cancelled() and future.exception() is None:
            done(future.result())
        else:
            left.append(case)
    return left


def on_cluster(cases: Sequence[Case], cluster: Any, keep: str, folder: str, done: Done) -> None:
    """Carry out runs on a Dask cluster; arguments as for `locally`.

    A worker that dies takes no run with it: the scheduler gives its runs to others. What is kept of
    runs goes to the campaign's folder, which the workers must reach under the same path. All of
    them must have the program of this process: its control laws are compiled into its core, and
    those that a lab has added are in no other.

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
        of: dict[str, Case] = {}

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
    """Return a client of a cluster: that which was given, or one for as long as it is used.

    Raises:
        InputError: nobody answers at the address.
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
    """Refuse workers that would compute something else.

    Raises:
        InputError: with their addresses.
    """
    found = client.run(program, on_error="return")
    others = {worker: has for worker, has in found.items() if has != ours}
    if others:
        told = "; ".join(
            f"{worker}: {has if isinstance(has, str) else type(has).__name__ + f': {has}'}"
            for worker, has in sorted(others.items())
        )
        raise InputError(
            "not every worker has the same rthyb_rt and the same control laws as this process "
            f"(here: {ours}; workers that differ: {told}); install the same sources on every "
            "machine",
            address,
        )


def _why(error: BaseException | None) -> str:
    name = type(error).__name__
    return "its worker was terminated repeatedly" if name == "KilledWorker" else f"{name}: {error}"
