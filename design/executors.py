"""Work items in other processes or on other machines, through the interface of
`concurrent.futures`. Work that is lost when a worker dies is repeated."""

from __future__ import annotations

import ast
import pickle
import sys
import threading
import traceback
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from pathlib import Path

import torchfilm as tf
from design.scoring import WorkItem, WorkResult, run_work_item
from design.task import Task
from torchfilm import checks

# how often a lost work item is submitted again; Dask itself tries four workers each time
RETRIES = 1
# threads of one process share its growth recordings, and only one may extend them at a time
_TURN = threading.Lock()


def run_work_items(
    task: Task, items: list[WorkItem], streams: tuple[int, ...], size: float, executor: Executor
) -> Iterator[tuple[WorkItem, WorkResult]]:
    """Yield each work item once, with its result.

    A work item that the executor loses is submitted again. If it is lost again, this process runs
    it and warns. Raises InputError for a pool whose workers would hang.
    """
    check_executor(executor)
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
        checks.warn(
            f"the executor lost {len(lost)} of {len(items)} work items; this process ran them"
            f" ({type(lost[-1]).__name__}: {lost[-1]})",
            category=RuntimeWarning,
        )


def check_executor(executor: Executor) -> None:
    """Raises InputError for a pool of processes that would hang: one that forks, and one in a
    script without a guard, which every worker would run from its beginning."""
    if not callable(getattr(executor, "submit", None)):
        raise checks.input_error(
            "executor", executor, "an executor, such as ProcessPoolExecutor(4), or None"
        )
    if not isinstance(executor, ProcessPoolExecutor):
        return
    # the pool has no public name for it; without one, its workers are not checked
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise checks.input_error(
            "executor",
            "a ProcessPoolExecutor that forks",
            "one with new processes",
            "Threads of torch do not survive a fork, so its workers would hang. Give it"
            ' mp_context=multiprocessing.get_context("spawn").',
        )
    if _unguarded():
        raise tf.InputError(
            "executor: every worker imports this script and would begin the search again. Put what"
            ' the script runs under if __name__ == "__main__":.'
        )


def _unguarded() -> bool:
    """Whether a script is running, at its top level, that a worker imports (`__mp_main__`), or
    that has no test of `__name__` to keep a worker from running it."""
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        if frame.f_code.co_name != "<module>":
            continue
        name, path = frame.f_globals.get("__name__"), frame.f_globals.get("__file__")
        if name == "__mp_main__":
            return True
        spec = frame.f_globals.get("__spec__")
        if spec is not None and spec.name.endswith("__main__"):
            return False  # of a package, which workers do not import
        if name == "__main__" and path is not None and Path(path).is_file():
            return not _has_guard(Path(path).read_bytes())
    return False


def _has_guard(source: bytes) -> bool:
    """Whether a test outside of functions and classes of a script reads `__name__`; True where it
    is no source."""
    try:
        parsed = ast.parse(source)
    except (SyntaxError, ValueError):
        return True
    inner = ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda
    nodes: list[ast.AST] = list(parsed.body)
    for node in nodes:
        if isinstance(node, inner):
            continue
        if isinstance(node, (ast.If, ast.IfExp)):
            names = [n.id for n in ast.walk(node.test) if isinstance(n, ast.Name)]
            if "__name__" in names:
                return True
        nodes += ast.iter_child_nodes(node)
    return False


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


def _is_of_pickling(task: Task, error: Exception) -> bool:
    """Whether an executor failed because a worker cannot get the task, and not by itself."""
    if isinstance(error, (pickle.PicklingError, ImportError)):
        return True
    if not isinstance(error, (AttributeError, TypeError)):
        return False
    if "Can't get attribute" in str(error):  # of a worker that has other code
        return True
    try:
        pickle.loads(pickle.dumps(task))
    except Exception:
        return True
    return False


def _check_pickled(task: Task, error: Exception) -> None:
    """Raises InputError where an executor failed because the task cannot be pickled."""
    if _is_of_pickling(task, error):
        function = task.family.function
        name = getattr(function, "__qualname__", repr(function))
        raise tf.InputError(
            f"{name} and its target cannot be pickled for a worker ({error}). Define the scene"
            " function at the top level of a module that the workers can import. Give it and the"
            " target no lambda and no open file."
        ) from error
