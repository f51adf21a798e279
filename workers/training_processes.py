"""Processes that train one network together (torch's distributed data parallel), started and ended by a worker."""

import tempfile
from collections.abc import Sequence
from contextlib import suppress
from copy import deepcopy
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch
from torch import distributed, multiprocessing

from models.distributed import DistributedNetwork
from models.network import Network
from models.segments import SegmentBatch
from models.training import TrainingState, advance

ENDING, LOOK = 10.0, 0.5  # seconds that processes are given to end by themselves; between two looks at all of them


class TrainingProcesses:
    """One process a device, e.g. ("cuda:0", "cuda:1") or ("cpu", "cpu"), one thread each on a processor.

    Use as a context; a process that dies ends the others with it, and what `advance` gave back before is kept.
    """

    def __init__(self, network: Network, dataset: SegmentBatch, state: TrainingState, devices: Sequence[str]) -> None:
        """Raises ValueError where a minibatch does not give each process equally many segments."""
        size = min(state.config.batch_size, dataset.size)
        if size % len(devices):
            raise ValueError(f"A minibatch of {size} segments cannot be shared by {len(devices)} processes.")
        self._folder = tempfile.TemporaryDirectory(prefix="asim-training-")
        context = multiprocessing.get_context("spawn")
        place = str(Path(self._folder.name) / "rendezvous")
        self._connections: list[Connection] = []
        self._processes: list[Any] = []
        for rank, device in enumerate(devices):
            here, there = context.Pipe()
            told = ((rank, len(devices), device, place), network, dataset, state, there)
            self._processes.append(context.Process(target=_serve, args=told, daemon=True))
            self._connections.append(here)
            self._processes[-1].start()
            there.close()

    def advance(self, until: int) -> tuple[TrainingState, float]:
        """Train to step `until`: the state, and the loss of the last step.

        Raises what training raises, and RuntimeError when a process died.
        """
        for rank, connection in enumerate(self._connections):
            try:
                connection.send(until)
            except OSError as error:
                raise self._death(rank) from error
        answers: dict[int, Any] = {}
        while len(answers) < len(self._connections):
            missing = [rank for rank in range(len(self._connections)) if rank not in answers]
            self._require_alive(missing)
            answers |= {rank: self._received(rank) for rank in missing if self._connections[rank].poll(LOOK)}
        state, loss = answers[0]
        return state, loss

    def __enter__(self) -> "TrainingProcesses":
        return self

    def __exit__(self, *_: object) -> None:
        for connection in self._connections:
            with suppress(OSError):  # it has died before
                connection.send(None)
        for process in self._processes:
            process.join(ENDING)
            if process.is_alive():
                process.kill()
                process.join()
        self._folder.cleanup()

    def _require_alive(self, ranks: Sequence[int]) -> None:
        """The others would wait for a dead one for ever."""
        for rank in ranks:
            if not self._processes[rank].is_alive() and not self._connections[rank].poll():
                raise self._death(rank)

    def _received(self, rank: int) -> Any:
        """Raises at once what a process raised: the others may wait for it. A dead one is the reason of all else."""
        try:
            answer = self._connections[rank].recv()
        except (EOFError, OSError) as error:
            raise self._death(rank) from error
        if isinstance(answer, Exception):
            ended = wait([process.sentinel for process in self._processes], LOOK)
            dead = [number for number, process in enumerate(self._processes) if process.sentinel in ended]
            raise self._death(dead[0]) if dead else answer
        return answer

    def _death(self, rank: int) -> RuntimeError:
        self._processes[rank].join(ENDING)
        return RuntimeError(f"Training process {rank} ended with status {self._processes[rank].exitcode}.")


def _serve(
    about: tuple[int, int, str, str],
    network: Network,
    dataset: SegmentBatch,
    state: TrainingState,
    parent: Connection,
) -> None:
    """A process's life: trains to each step that the parent names, until it names none."""
    rank, processes, device, place = about
    torch.set_num_threads(1)
    backend = "nccl" if device.startswith("cuda") else "gloo"
    if backend == "nccl":
        torch.cuda.set_device(device)
    distributed.init_process_group(backend, init_method=f"file://{place}", rank=rank, world_size=processes)
    shared = DistributedNetwork(deepcopy(network))  # what came from the parent is one memory for all processes
    losses = [0.0]
    with suppress(EOFError):  # the parent has died
        for until in iter(parent.recv, None):
            try:
                state = advance(shared, dataset, state, until, device, progress=lambda _, __, loss: losses.append(loss))
            except Exception as error:  # the parent raises it
                parent.send(error)
            else:
                parent.send((state, losses[-1]) if rank == 0 else None)
    distributed.destroy_process_group()
