"""Training in several processes that `torchrun` starts: each process takes a share of the scenes.

The processes hold the same weights and see the same global batch, split by rows. Their losses add
up to the loss of one process, and DistributedDataParallel adds their gradients. Every process draws
the random numbers of the whole batch and keeps those of its rows (`SharedGenerator`). So a run with
another number of processes differs by the rounding of sums only. Rounding may change a Gibbs draw.

Without `torchrun`, there is one process, and all functions return their input unchanged.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

T = TypeVar("T")

# The other processes wait while the first trains the objects. `torchrun` ends them if one fails.
_TIMEOUT = timedelta(days=1)


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes of `torchrun`: gloo for CPU tensors, nccl for CUDA tensors."""
    if not dist.is_torchelastic_launched():
        yield
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=_TIMEOUT)
    try:
        yield
    finally:
        # A DistributedDataParallel module that outlives the group can abort the process at its end.
        gc.collect()
        dist.destroy_process_group()


def size() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Return the number of this process, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def is_first() -> bool:
    """Return whether this process writes files and shows progress."""
    return rank() == 0


def device_of(setting: str) -> torch.device:
    """Return the device of this process for the setting auto, cpu or cuda."""
    if setting == "cpu" or (setting == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    return torch.device("cuda", dist.get_node_local_rank(fallback_rank=0))


def parallel(module: nn.Module) -> nn.Module:
    """Return the module, whose gradients are the mean over the processes."""
    if size() == 1:
        return module
    # A batch may leave weights unused in some processes, such as those of relations.
    return DistributedDataParallel(module, forward_sync_buffers=False, find_unused_parameters=True)


class SharedGenerator(torch.Generator):
    """A generator with the same state in all processes; each process uses the draws of its rows."""


def new_generator(seed: int) -> torch.Generator:
    """Return a generator for rows that are split between the processes."""
    generator = torch.Generator() if size() == 1 else SharedGenerator()
    return generator.manual_seed(seed)


def own_rows(rows: int, generator: torch.Generator | None) -> tuple[int, int]:
    """Return the index of the first of this process' rows among all rows, and their number.

    Only a `SharedGenerator` has rows of other processes.
    """
    if not isinstance(generator, SharedGenerator):
        return 0, rows
    counts = torch.zeros(size(), dtype=torch.int64, device="cpu")
    counts[rank()] = rows
    dist.all_reduce(counts)
    return int(counts[: rank()].sum()), int(counts.sum())


def widest(v: Tensor, generator: torch.Generator) -> int:
    """Return the largest number of present classes in the rows of all processes, 0 for one."""
    if not isinstance(generator, SharedGenerator):
        return 0
    width = torch.tensor(int((v > 0).sum(1).max()) if len(v) else 0, device="cpu")
    dist.all_reduce(width, dist.ReduceOp.MAX)
    return int(width)


def share(rows: Tensor) -> Tensor:
    """Return this process' share of the rows."""
    return rows if size() == 1 else rows.tensor_split(size())[rank()]


def gather(rows: Tensor) -> Tensor:
    """Return the rows of all processes, in order."""
    if size() == 1:
        return rows
    parts: list[Tensor] = [rows] * size()
    dist.all_gather_object(parts, rows.cpu())
    return torch.cat(parts).to(rows.device)


def total(values: Tensor) -> Tensor:
    """Return the sum over the processes."""
    if size() > 1:
        dist.all_reduce(values)
    return values


def anywhere(flags: Tensor) -> bool:
    """Return whether a flag is true in any process."""
    return bool(total(flags.any().int()))


def mean_part(values: Tensor) -> Tensor:
    """Return this process' part of the mean over all rows; the parts add up to the mean."""
    if size() == 1:
        return values.mean(0)
    return values.sum(0) / total(torch.tensor(len(values))).clamp(min=1)


def spread(works: Sequence[Callable[[], T]]) -> list[T]:
    """Return the results of all functions, which the processes compute in turn.

    All processes raise the first error.
    """
    if size() == 1:
        return [work() for work in works]
    parts: list[list[tuple[T | None, Exception | None]]] = [[] for _ in range(size())]
    dist.all_gather_object(parts, [_outcome(work) for work in works[rank() :: size()]])
    results = []
    for k in range(len(works)):
        result, error = parts[k % size()][k // size()]
        if error is not None:
            raise error
        results.append(result)
    return results  # type: ignore[return-value]


def on_first(work: Callable[[], T]) -> T:
    """Return the result of a function that the first process computes."""
    return spread([work])[0]


def _outcome(work: Callable[[], T]) -> tuple[T | None, Exception | None]:
    try:
        return work(), None
    except Exception as error:  # noqa: BLE001 - raised in all processes
        return None, error
