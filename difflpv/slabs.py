"""Launches of a kernel on slabs of its first dimension, one per thread: Warp itself runs a launch on the CPU on one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import torch

from difflpv.bridge import record, replay

__all__ = ["SlabLauncher"]


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="difflpv-slab")


class SlabLauncher:
    """Launches a kernel on slabs of its first dimension, one per thread on the CPU; replays what an earlier step recorded."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._commands: dict[tuple[Any, int, int], list[Any]] = {}  # recorded: a generic launch costs ten replays

    def launch(self, kernel: Any, items: int, width: int, arguments: list[Any], *, first: int = 0) -> None:
        """Run ``items`` x ``width`` threads, items from ``first``; the kernel's last argument is the first item of a slab."""
        if not items:
            return
        threads = 1 if self.device.type == "cuda" else max(1, min(torch.get_num_threads(), items))
        bounds = [first + items * i // threads for i in range(threads + 1)]
        if (kernel, threads, first) not in self._commands:
            self._commands[kernel, threads, first] = [
                record(kernel, (bounds[i + 1] - bounds[i], width), [*arguments, bounds[i]], self.device) for i in range(threads)
            ]
        commands = self._commands[kernel, threads, first]
        for command in commands:
            for index, value in enumerate(arguments):
                command.set_param_at_index_from_ctype(index, value)
        waiting = [_pool(threads).submit(command.launch) for command in commands[1:]]
        replay(commands[0], self.device)
        for future in waiting:
            future.result()

    def release(self) -> None:
        """Forget the recorded launches, which keep the buffers of the last one alive."""
        self._commands.clear()
