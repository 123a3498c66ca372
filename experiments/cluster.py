"""Tests that a cluster loses nothing if one worker is killed during an evaluation.

    python experiments/cluster.py                           # two workers on this machine
    python experiments/cluster.py --scheduler tcp://…:8786  # your workers; one of them is killed

The script scores designs of the boundary detector for a stripe at the border three times: in this
process, on the workers, and on the workers while it kills one of them. All losses must be identical
to the last bit. It requires distributed (the `cluster` extra).
"""

from __future__ import annotations

import argparse
import os
import signal
import threading

import numpy as np
import torch
from arguments import not_allowed, whole
from distributed import Client, LocalCluster

from design import Objective, Parameter, Stripe, Task


def kill(pid: int) -> None:
    """Kills a process without warning."""
    os.kill(pid, signal.SIGKILL)


def running(text: str) -> str:
    """The address of a scheduler that answers."""
    try:
        Client(text, timeout=5).close()
    except (OSError, ValueError) as error:
        allowed = f"the address of a scheduler that runs, such as tcp://host:8786 ({error})"
        raise not_allowed(text, allowed) from None
    return text


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scheduler",
        type=running,
        help="address of a running scheduler; default: two workers on this machine",
    )
    parser.add_argument("--cells", type=whole, default=60)
    parser.add_argument("--designs", type=whole, default=32)
    parser.add_argument("--work-items", type=whole, default=4)
    options = parser.parse_args()
    parameters, target = (
        [Parameter("k3", 0.1, 10, log=True), Parameter("d3", 1e-3, 1.0, log=True)],
        Stripe("yfp", width=8.0, cell_type=1),
    )
    task = Task("boundary_detector", parameters, target, cells=options.cells, replicates=2)
    objective = Objective(task)
    points = np.random.default_rng(0).random((options.designs, 2))
    here = objective.evaluate(points)
    print(
        f"here: {here.losses.size} colonies in {here.seconds:.1f} s, best loss"
        f" {here.loss.min():.4f}",
        flush=True,
    )
    cluster = options.scheduler or LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0"
    )
    with Client(cluster) as client:
        executor = client.get_executor(pure=False)
        objective.evaluate(
            points[:2], executor=executor, work_items=2
        )  # each worker imports torch once
        undisturbed = objective.evaluate(points, executor=executor, work_items=options.work_items)
        print(
            f"{len(client.run(os.getpid))} workers: {undisturbed.seconds:.1f} s, identical:"
            f" {np.array_equal(undisturbed.losses, here.losses)}",
            flush=True,
        )
        address, pid = next(iter(client.run(os.getpid).items()))
        killer = threading.Timer(
            0.5 * undisturbed.seconds,
            lambda: client.run(kill, pid, workers=[address], on_error="ignore"),
        )
        killer.start()
        disturbed = objective.evaluate(points, executor=executor, work_items=options.work_items)
        print(
            f"worker {pid} killed after {0.5 * undisturbed.seconds:.1f} s"
            f" of {disturbed.seconds:.1f} s;"
            f" workers now {list(client.run(os.getpid).values())}"
        )
        print(
            f"{np.isnan(disturbed.losses).sum()} colonies lost, identical:"
            f" {np.array_equal(disturbed.losses, here.losses)}"
        )
        killer.join()
    if not options.scheduler:
        cluster.close()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
