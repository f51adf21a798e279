"""Answering in a process of its own: a simulator that hangs or crashes takes one item with it, and not the labeler."""

import contextlib
import multiprocessing
import os
import signal
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from uuid import UUID

import numpy as np

from api_schemas.acquisitions import AcquisitionItem
from api_schemas.errors import Problem
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import AsimError, ServiceError, Unreachable, service_error
from workers.answering import SimulatorAnswerer
from workers.behaviors import behaviors_of
from workers.delivery import Answer
from workers.orphans import end_with
from workers.simulators.base import SimulatorError, SimulatorUnavailable
from workers.unanswerable import ProcessEnded, UnanswerableItem

START_SECONDS = 300.0  # to import a simulator and make its scene
IN_A_ROW = 3  # items that cost a process each, after which no other is started


@dataclass(frozen=True)
class Answered:
    """What the process says: an answer, or why there is none; and how far the generator has come."""

    generator: np.random.Generator
    answer: Answer | None = None
    unanswerable: str | None = None
    problem: Problem | None = None
    unreachable: str | None = None


class AnsweringProcess:
    """Has items answered by a child process, which is killed where one of them takes too long, and started again."""

    def __init__(self, url: str, key: str | None, seconds: float, project: Project) -> None:
        """url, key: where the child finds the service. seconds: that an item may take. Raises SimulatorUnavailable."""
        self._service, self._seconds, self._project = (url, key), seconds, project.id
        self._ended = 0  # processes in a row that ended over an item
        self._process: multiprocessing.process.BaseProcess | None = None
        self._name = self._start()

    @property
    def name(self) -> str:
        """The simulator's."""
        return self._name

    def answer(self, item: AcquisitionItem, generator: np.random.Generator) -> Answer:
        """As if the simulator were here: the generator goes on likewise. Raises ProcessEnded where it hangs or dies."""
        if self._ended == IN_A_ROW:
            raise ProcessEnded(item, f"was not tried: each of {IN_A_ROW} items before it ended the simulator's process")
        answered = self._answered(item, generator)
        self._ended = 0
        generator.bit_generator.state = answered.generator.bit_generator.state
        return _told(answered)

    def close(self) -> None:
        """End the child."""
        self._kill()

    def _start(self) -> str:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, os.getpid(), *self._service, self._project), name="simulator", daemon=True
        )
        self._process.start()
        theirs.close()
        try:
            said = self._pipe.recv() if self._pipe.poll(START_SECONDS) else SimulatorUnavailable(_SLOW)
        except EOFError:
            said = SimulatorUnavailable(f"the simulator's process {self._death()} while it started")
        if isinstance(said, str):
            return said
        self._kill()
        raise said

    def _answered(self, item: AcquisitionItem, generator: np.random.Generator) -> Answered:
        began = time.monotonic()
        try:
            if self._process is None:
                self._start()
                began = time.monotonic()
            self._pipe.send((item, generator))
            if self._pipe.poll(self._seconds):
                found: Answered = self._pipe.recv()
                return found
            reason = f"took longer than {self._seconds:g} s and was ended with the simulator's process (--item-seconds)"
        except SimulatorUnavailable as error:
            reason = f"was not answered: {error}"
        except (EOFError, OSError):
            passed = time.monotonic() - began
            reason = f"was not answered: the simulator's process {self._death()} over it after {passed:.1f} s"
        self._kill()
        self._ended += 1
        raise ProcessEnded(item, reason)

    def _death(self) -> str:
        """How the process ended, which has closed its end of the pipe."""
        if self._process is not None:
            self._process.join(5.0)
        status = None if self._process is None else self._process.exitcode
        return f"died of {signal.Signals(-status).name}" if status is not None and status < 0 else f"ended ({status})"

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = None


_SLOW = f"the simulator did not start within {START_SECONDS:g} s"


def _told(answered: Answered) -> Answer:
    if answered.problem is not None:
        raise service_error(answered.problem)
    if answered.unreachable is not None:
        raise Unreachable(answered.unreachable)
    if answered.answer is None:
        raise UnanswerableItem(answered.unanswerable)
    return answered.answer


def _serve(pipe: Connection, parent: int, url: str, key: str | None, project: UUID) -> None:
    """The child: answers what comes, until its parent is gone, which may be so already."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal is the parent's, which then ends this one
    end_with(parent)
    with contextlib.suppress(EOFError, BrokenPipeError), Client(url, key) as client:
        try:
            answerer = SimulatorAnswerer(client, client.project(project), behaviors_of(client, project))
        except (SimulatorError, AsimError) as error:
            pipe.send(SimulatorUnavailable(str(error)))
            return
        with contextlib.closing(answerer):
            pipe.send(answerer.name)
            while True:
                pipe.send(_answered(answerer, *pipe.recv()))


def _answered(answerer: SimulatorAnswerer, item: AcquisitionItem, generator: np.random.Generator) -> Answered:
    try:
        return Answered(generator, answer=answerer.answer(item, generator))
    except UnanswerableItem as error:
        return Answered(generator, unanswerable=str(error))
    except ServiceError as error:
        return Answered(generator, problem=error.problem)
    except Unreachable as error:
        return Answered(generator, unreachable=str(error))
