"""A thread that works off only the newest request: a slider sends dozens while it moves, and a solve takes longer than that."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["LatestWorker"]

T = TypeVar("T")


class LatestWorker(Generic[T]):
    """Calls ``work`` on requests, one at a time, in a thread of its own; a request that waits is replaced by the next.

    An exception of ``work`` goes to ``failed`` and the thread goes on.
    """

    def __init__(self, work: Callable[[T], None], failed: Callable[[Exception], None]) -> None:
        self._work, self._failed = work, failed
        self._change = threading.Condition()
        self._waiting: list[T] = []
        self._busy = self._closed = False
        self._thread = threading.Thread(target=self._run, name="difflpv-view", daemon=True)
        self._thread.start()

    def submit(self, request: T) -> None:
        """Ask for work on ``request`` instead of whatever still waits; returns at once."""
        with self._change:
            self._waiting = [request]
            self._change.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until nothing is left to do; False if that took longer than ``timeout`` seconds."""
        with self._change:
            return self._change.wait_for(lambda: not self._busy and not self._waiting, timeout)

    def close(self) -> None:
        """Finish what is being worked on, drop what waits, end the thread."""
        with self._change:
            self._closed, self._waiting = True, []
            self._change.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                request = self._waiting.pop()
                self._busy = True
            try:
                self._work(request)
            except Exception as error:
                self._failed(error)
            finally:
                with self._change:
                    self._busy = False
                    self._change.notify_all()
