"""What a search method proposes: a batch, of which a part is left where the budget ends within it,
and what the method learns from it."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, replace

import numpy as np

import torchfilm as tf
from design.entries import Entry
from design.known import KnownDesigns
from design.methods import METHODS, Batch, Method, method_of
from design.objective import Objective
from design.study import Study
from design.task import Task
from torchfilm import checks


@dataclass(eq=False)
class Proposal:
    """batch: what a method proposes; entry: the first of its designs, which have been grown. known:
    the batch is of these designs, and no method's; number: of the batch, from 0. choosing: seconds
    that the method took for it."""

    batch: Batch
    known: KnownDesigns | None = None
    number: int = 0
    choosing: float = 0.0
    entry: Entry | None = None

    @classmethod
    def of_number(
        cls, number: int, method: Method, task: Task, known: KnownDesigns | None
    ) -> Proposal:
        """The batch of a number, from 0: the known designs first of all, then what a method
        proposes."""
        if known is not None and number < len(known.batches):
            return cls(Batch(known.batches[number]), known, number)  # their losses alone are told
        begun = time.perf_counter()
        batch = method.ask()
        seconds = time.perf_counter() - begun
        if not isinstance(batch, Batch):
            raise tf.InputError(
                f"{type(method).__name__}.ask must return a design.Batch of points"
                f" (n, {task.space.size}), not {type(batch).__name__}."
            )
        return cls(batch, choosing=seconds)

    @property
    def done(self) -> int:
        """Designs that have been grown."""
        return 0 if self.entry is None else len(self.entry.points)

    @property
    def complete(self) -> bool:
        return self.done == len(self.batch.points)

    def part(self, objective: Objective, colonies: float) -> Batch | None:
        """As many of the designs that are left as `colonies` allow; None where that is none."""
        most = objective.task.replicates
        replicates = min(self.batch.replicates or most, most)
        cost = replicates * self.batch.size * objective.copies(self.batch.slopes)
        rows = min(int(colonies / cost + 1e-9), len(self.batch.points) - self.done)
        if rows < 1:
            return None
        chosen = self.batch.points[self.done : self.done + rows]
        return replace(self.batch, points=chosen, replicates=replicates)

    def take(self, entry: Entry, study: Study) -> None:
        """Keep further designs that have been grown, here and in the study."""
        first = self.entry is None
        if self.entry is None:
            self.entry = replace(entry, choosing=self.choosing)
        else:
            self.entry = self.entry.followed_by(entry)
        study.add(self.entry, replace=not first)

    def tell(self, method: Method) -> None:
        """Let a method learn the whole batch. Methods that never ask for slopes or residuals need
        not take any."""
        assert self.entry is not None
        if self.known is not None:
            self._tell_known(method, self.known)
            return
        # copies: a method may write into the arrays that it gets, and the study must not change
        found = copy.deepcopy(self.entry.target_losses)
        batch = replace(self.batch, points=self.entry.points)
        slopes = (copy.deepcopy(self.entry.slopes),) if batch.slopes else ()
        more = {"residuals": copy.deepcopy(self.entry.residuals)} if batch.residuals else {}
        method.tell(batch, found, *slopes, **more)

    def _tell_known(self, method: Method, known: KnownDesigns) -> None:
        """Let a method learn all known designs at once, with the last batch of them."""
        assert self.entry is not None
        know = getattr(method, "know", None)
        if know is None or self.number < len(known.batches) - 1:
            return
        before = [known.entry] if known.entry is not None and self.number else []
        every = [*before, self.entry]
        know(
            np.concatenate([e.points for e in every]),
            np.concatenate([e.target_losses for e in every]),
        )


def repeat_study(
    method: Method, task: Task, study: Study, known: KnownDesigns | None
) -> Proposal | None:
    """Bring a method to where the study ends: it proposes each batch again and learns its losses.
    Returns the proposal of which only a part was grown, if any. Raises InputError where the method
    proposes other points."""
    recall = getattr(method, "recall", None)
    for k, entry in enumerate(study.entries):
        if recall is not None:  # of the last batch it may have grown only a part
            recall(entry.points.copy() if k < len(study.entries) - 1 else None)
        proposal = Proposal.of_number(k, method, task, known)
        proposal.entry = entry
        wanted = proposal.batch.points[: proposal.done]
        whole = proposal.complete or k == len(study.entries) - 1
        # another machine may round in another way
        if (
            not whole
            or wanted.shape != entry.points.shape
            or not np.allclose(wanted, entry.points, rtol=0, atol=1e-6)
        ):
            raise tf.InputError(
                f"{study.path}: the method proposes other points than its batch {k} holds; another"
                " version of the method may have made the file. A method of your own draws from"
                " numbers by seed and batch, or has `recall`. Another study goes on with what this"
                f" one knows by start={str(study.path)!r}."
            )
        if not proposal.complete:
            return proposal
        proposal.tell(method)
    return None


def checked_method(method: str | Method, task: Task) -> str | Method:
    """The method of a search; "auto" stays. Raises InputError for one that is not allowed."""
    if isinstance(method, str):
        checks.choice("method", method, ("auto", *METHODS))
        if method == "auto":
            return method
    found = method_of(method)
    several = bool(getattr(found, "several", False))
    if several != bool(task.goals):
        raise checks.input_error(
            "method",
            type(found).__name__,
            'one for several goals, such as "nsga2"' if task.goals else "one for one target",
            "" if task.goals else "NSGA2 needs targets=[…].",
        )
    if getattr(found, "squares", False) and not task.target.comparable:
        raise checks.input_error(
            "method", type(found).__name__, "one for any target",
            f"{type(found).__name__} needs the residuals of data, such as Observed or Measured.",
        )  # fmt: skip
    return found
