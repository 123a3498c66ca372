"""Pieces of an evaluation on other processes or machines, by the interface of `concurrent.futures`:
what a worker takes along as it dies is done again."""

from __future__ import annotations

import pickle
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from typing import TYPE_CHECKING

import torchfilm as tf

if TYPE_CHECKING:
    from design.objective import Objective, Outcome, WorkItem

# times that a lost piece is given to the executor anew; Dask tries by itself with four workers each
# time
AGAIN = 1
# threads of one process share its recorded growth, which only one may lengthen at a time
_TURN = threading.Lock()


def outcomes(
    objective: Objective,
    pieces: list[WorkItem],
    streams: tuple[int, ...],
    size: float,
    executor: Executor,
) -> Iterator[tuple[WorkItem, Outcome]]:
    """Each piece with what became of it, once; those that the executor loses are given to it again,
    and in the end done here, with a warning."""
    lost: list[Exception] = []
    waiting = deque(
        (piece, _submit(executor, objective, piece, streams, size, 0), 0) for piece in pieces
    )
    try:
        while waiting:
            piece, future, times = waiting.popleft()
            try:
                found = future.result()
            # not the piece's own, which is an answer: the executor could not carry it, or its
            # worker is gone
            except Exception as error:
                _check_carried(objective, error)
                if times < AGAIN:
                    waiting.append(
                        (
                            piece,
                            _submit(executor, objective, piece, streams, size, times + 1),
                            times + 1,
                        )
                    )
                    continue
                lost.append(error)
                found = _run(objective, piece, streams, size)
            if isinstance(found, Exception):
                raise found
            yield piece, found
    finally:
        for _, future, _ in waiting:
            future.cancel()
    if lost:
        words = (
            f"the executor lost {len(lost)} of {len(pieces)} pieces, which were grown in this"
            f" process ({type(lost[-1]).__name__}: {lost[-1]})"
        )
        warnings.warn(words, RuntimeWarning, stacklevel=4)


def _submit(
    executor: Executor,
    objective: Objective,
    piece: WorkItem,
    streams: tuple[int, ...],
    size: float,
    times: int,
) -> Future[Outcome | Exception]:
    """A piece given to an executor; what it says against that is kept in the future, as what
    happens later is."""
    try:
        return executor.submit(_run, objective, piece, streams, size, times)
    except Exception as error:
        future: Future[Outcome | Exception] = Future()
        future.set_exception(error)
        return future


def _run(
    objective: Objective, piece: WorkItem, streams: tuple[int, ...], size: float, times: int = 0
) -> Outcome | Exception:
    """A piece in another process or thread. Its own error is an answer too, so that whatever the
    future raises is the executor's.

    times: how often it was lost before; a cluster that keeps answers by what was asked (Dask) must
    see a new question.
    """
    try:
        with _TURN:
            return objective.run(piece, streams, size)
    except Exception as error:
        error.add_note("Where it was raised:\n" + traceback.format_exc())
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return RuntimeError(
                f"{type(error).__name__}: {error}\nWhere it was raised:\n{traceback.format_exc()}"
            )
        return error


def _check_carried(objective: Objective, error: Exception) -> None:
    """Raises InputError where an executor failed because it cannot carry the objective to another
    process."""
    if isinstance(error, (pickle.PicklingError, AttributeError, TypeError, ImportError)):
        name = getattr(objective.make, "__qualname__", repr(objective.make))
        raise tf.InputError(
            f"{name} and its target cannot be carried to a worker ({error}). Define the scene at"
            " the top level of a module that the workers can import, not inside a function and not"
            " as a lambda, and give it and the target nothing that belongs to one process, such as"
            " open files."
        ) from error
