"""Worker processes: started afresh, and Ctrl-C is their parent's to handle."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

__all__ = ["start_pool"]


def start_pool(workers: int, initializer: Callable[..., None] | None = None, *arguments: Any) -> ProcessPoolExecutor:
    """Processes that ignore Ctrl-C, which the terminal sends to them too: the parent keeps what is done and ends them.

    Args:
        workers: number of processes, spawned: a fork would share Embree's and BLAS's threads.
        initializer: called in each of them with ``arguments`` before any work.
        *arguments: can be pickled.
    """
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(initializer, arguments))
    with _held_back():  # they inherit it: a Ctrl-C while they still import would end them with a traceback each
        for _ in range(workers):
            pool.submit(int)  # starts a process
    return pool


@contextmanager
def _held_back() -> Iterator[None]:
    """Ctrl-C waits until the end."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start(initializer: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if initializer is not None:
        initializer(*arguments)
