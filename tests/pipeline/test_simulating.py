"""Trajectories whose writers work while the next one is computed."""

import threading
import weakref
from dataclasses import replace

from nsf.data import TrajectoryWriter
from nsf.gpu import without_collection
from nsf.pipeline.stages import simulation


def test_a_solver_is_gone_before_the_next_is_made(pipeline_at, tmp_path, monkeypatch):
    """Also while its writer still works: else memory of a GPU is freed while the next captures a graph."""
    start, append = simulation._start, TrajectoryWriter.append
    solvers, left, begun = [], [], threading.Event()

    def started(job, *rest):
        def build():
            solver = job.build()
            solvers.append(weakref.ref(solver))
            return solver

        left.append(sum(solver() is not None for solver in solvers))
        if solvers:
            begun.set()
        return start(replace(job, build=build), *rest)

    def late(writer, *args, **fields):
        assert begun.wait(60)
        append(writer, *args, **fields)

    monkeypatch.setattr(simulation, "_start", started)
    monkeypatch.setattr(TrajectoryWriter, "append", late)
    with without_collection():  # which would free what holds itself
        pipeline_at(tmp_path).simulate()
    assert len(solvers) > 1
    assert left == [0] * len(solvers)
    assert not any(solver() for solver in solvers)
