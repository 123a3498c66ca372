"""Work items in other processes or on other machines, through the interface of
`concurrent.futures`. Work that is lost when a worker dies is repeated."""

from __future__ import annotations

import pickle
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, Future

import torchfilm as tf
from design.scoring import WorkItem, WorkResult, run_work_item
from design.task import Task

# how often a lost work item is submitted again; Dask itself tries four workers each time
RETRIES = 1
# threads of one process share its growth recordings, and only one may extend them at a time
_TURN = threading.Lock()


def run_work_items(
    task: Task, items: list[WorkItem], streams: tuple[int, ...], size: float, executor: Executor
) -> Iterator[tuple[WorkItem, WorkResult]]:
    """Yield each work item once, with its result.

    A work item that the executor loses is submitted again. If it is lost again, this process runs
    it and warns.
    """
    lost: list[Exception] = []
    waiting = deque((item, _submit(executor, task, item, streams, size, 0), 0) for item in items)
    try:
        while waiting:
            item, future, tries = waiting.popleft()
            try:
                found = future.result()
            # an error of the work item itself is a result; this one is the executor's: it could
            # not carry the work item, or its worker is gone
            except Exception as error:
                _check_pickled(task, error)
                if tries < RETRIES:
                    again = _submit(executor, task, item, streams, size, tries + 1)
                    waiting.append((item, again, tries + 1))
                    continue
                lost.append(error)
                found = _run_guarded(task, item, streams, size)
            if isinstance(found, Exception):
                raise found
            yield item, found
    finally:
        for _, future, _ in waiting:
            future.cancel()
    if lost:
        warnings.warn(
            f"the executor lost {len(lost)} of {len(items)} work items; this process ran them"
            f" ({type(lost[-1]).__name__}: {lost[-1]})",
            RuntimeWarning,
            stacklevel=3,
        )


def _submit(
    executor: Executor,
    task: Task,
    item: WorkItem,
    streams: tuple[int, ...],
    size: float,
    tries: int,
) -> Future[WorkResult | Exception]:
    """Submit a work item. An error of `submit` is kept in the future, like errors that come
    later."""
    try:
        return executor.submit(_run_guarded, task, item, streams, size, tries)
    except Exception as error:
        future: Future[WorkResult | Exception] = Future()
        future.set_exception(error)
        return future


def _run_guarded(
    task: Task, item: WorkItem, streams: tuple[int, ...], size: float, tries: int = 0
) -> WorkResult | Exception:
    """Run a work item in another process or thread. It returns its own errors, so that whatever a
    future raises is an error of the executor.

    tries: how often the item was lost before. A cluster that caches results by their arguments
    (Dask) must see new arguments.
    """
    try:
        with _TURN:
            return run_work_item(task, item, streams, size)
    except Exception as error:
        error.add_note("Where it was raised:\n" + traceback.format_exc())
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return RuntimeError(
                f"{type(error).__name__}: {error}\nWhere it was raised:\n{traceback.format_exc()}"
            )
        return error


def _check_pickled(task: Task, error: Exception) -> None:
    """Raises InputError where an executor failed because the task cannot be pickled."""
    if isinstance(error, (pickle.PicklingError, AttributeError, TypeError, ImportError)):
        function = task.family.function
        name = getattr(function, "__qualname__", repr(function))
        raise tf.InputError(
            f"{name} and its target cannot be pickled for a worker ({error}). Define the scene"
            " function at the top level of a module that the workers can import. Give it and the"
            " target no lambda and no open file."
        ) from error
