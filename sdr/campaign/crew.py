"""Who computes a campaign: processes of this machine or a Dask cluster. A worker that dies costs its chunks' time alone.

Both give futures of ``submit(function, *args)``; ``each`` keeps them busy and hands out results as they come.
"""

import concurrent.futures as futures
import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

CONNECT_S = 10.0
"""A scheduler that does not answer for so long cannot be reached."""
_RETRIES = 3


class Local:
    """Processes of this machine; a process that dies is replaced and its chunks are computed again."""

    def __init__(self, workers: int, path: Path) -> None:
        self.workers, self._path, self._deaths = workers, path, 0
        self._start()

    def _start(self) -> None:
        import multiprocessing as mp

        # One BLAS thread each: more would quarrel over the cores.
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ.setdefault(name, "1")
        method = "forkserver" if "forkserver" in mp.get_all_start_methods() else "spawn"
        context = mp.get_context(method)
        if method == "forkserver":
            context.set_forkserver_preload(["sdr.campaign.trials"])
        self._pool = futures.ProcessPoolExecutor(
            self.workers, mp_context=context, initializer=_obey, initargs=(os.getpid(),)
        )

    def submit(self, function: Callable, *args: Any) -> futures.Future:
        """A future of ``function(*args)``."""
        try:
            return self._pool.submit(function, *args)
        except futures.BrokenExecutor:
            self.revive()
            return self._pool.submit(function, *args)

    def revive(self) -> None:
        """After a worker died: new processes, or an error if it happens again and again."""
        self._deaths += 1
        if self._deaths > _RETRIES:
            raise OSError(
                f"worker processes died {self._deaths} times (out of memory?); what was counted stays in "
                f"'{self._path}', run the command again to go on"
            )
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._start()

    def check(self) -> None:
        """Nothing to lose here."""

    def close(self, orderly: bool) -> None:
        """End the processes."""
        processes = list((getattr(self._pool, "_processes", None) or {}).values())
        self._pool.shutdown(wait=orderly, cancel_futures=True)
        if not orderly:
            for p in processes:
                p.terminate()


def _obey(parent: int) -> None:
    """Worker's start: interrupts are the parent's business, and without the parent there is no work."""
    import signal
    import threading

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def watch() -> None:
        while True:
            time.sleep(1.0)
            try:
                os.kill(parent, 0)
            except OSError:
                os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class Cluster:
    """A Dask scheduler and its workers, which need this package installed."""

    def __init__(self, address: str, path: Path) -> None:
        try:
            import distributed
        except ImportError:
            raise ImportError(
                "--scheduler needs the extra 'cluster': pip install gnss-baseband[cluster]"
            ) from None
        import logging

        # A lost connection is told in one sentence below, not in their traces.
        for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        logging.getLogger("tornado.application").setLevel(logging.CRITICAL)
        self.address, self._path = address, path
        self._threads, self._counted_at = 1, -math.inf
        try:
            self._client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as err:
            reason = " ".join(str(err).split())[:200]
            raise OSError(f"scheduler '{address}' cannot be reached: {reason}") from None
        self._executor = self._client.get_executor(pure=False, retries=_RETRIES)

    @property
    def workers(self) -> int:
        """Threads of all workers now."""
        if time.monotonic() - self._counted_at > 1.0:
            try:
                self._threads = max(1, sum(self._client.nthreads().values()))
            except (OSError, RuntimeError):
                raise OSError(self._lost()) from None
            self._counted_at = time.monotonic()
        return self._threads

    def submit(self, function: Callable, *args: Any) -> futures.Future:
        """A future of ``function(*args)``."""
        self.check()
        try:
            return self._executor.submit(function, *args)
        except (OSError, RuntimeError, ValueError):  # what a client says that has just lost its scheduler
            raise OSError(self._lost()) from None

    def revive(self) -> None:
        """A chunk was lost with its workers."""
        raise OSError(self._lost())

    def check(self) -> None:
        """Raise when the scheduler has gone."""
        comm = self._client.scheduler_comm
        if self._client.status != "running" or comm is None or comm.comm.closed():
            raise OSError(self._lost())

    def _lost(self) -> str:
        return (
            f"the cluster at '{self.address}' was lost; what was counted stays in '{self._path}', run the command "
            "again to go on"
        )

    def close(self, orderly: bool) -> None:
        """Leave the cluster as it was."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=2)


@contextlib.contextmanager
def hire(workers: int | None, scheduler: str | None, path: Path) -> Iterator[Any]:
    """Who computes: local processes, or the cluster at ``scheduler``; ended in good order, or at once after an error."""
    if scheduler is not None and workers is not None:
        raise ValueError("--workers counts local processes; with --scheduler the cluster has its own")
    if workers is not None and not 1 <= workers <= 1024:
        raise ValueError(f"--workers {workers}: give 1 to 1024")
    own = (
        workers or len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else workers or os.cpu_count() or 1
    )
    hands: Any = Cluster(scheduler, path) if scheduler is not None else Local(own, path)
    try:
        yield hands
    except BaseException:
        hands.close(False)
        raise
    hands.close(True)


def each(
    crew: Any, tasks: Iterator[tuple[Any, Callable, tuple]], ahead: Callable[[], int]
) -> Iterator[tuple[Any, Any]]:
    """Results (key, value) as they come, with at most ``ahead()`` tasks out at a time."""
    out: dict[futures.Future, tuple[Any, Callable, tuple]] = {}
    more = True
    try:
        while True:
            while more and len(out) < ahead():
                task = next(tasks, None)
                more = task is not None
                if task is not None:
                    out[crew.submit(task[1], *task[2])] = task
            if not out:
                return
            done, _ = futures.wait(out, timeout=1.0, return_when=futures.FIRST_COMPLETED)
            crew.check()
            for f in done:
                yield from _result(crew, f, out)
            more = True if done else more
    finally:
        for f in out:
            f.cancel()


def _result(crew: Any, f: futures.Future, out: dict) -> Iterator[tuple[Any, Any]]:
    if f not in out:
        return
    task = out[f]
    try:
        value = f.result()
    except (futures.BrokenExecutor, futures.CancelledError):
        lost = list(out.values())
        out.clear()
        crew.revive()
        for again in lost:
            out[crew.submit(again[1], *again[2])] = again
        return
    except Exception as err:
        if type(err).__module__.startswith("distributed") or isinstance(err, ConnectionError):
            crew.revive()
        raise
    del out[f]
    yield task[0], value
