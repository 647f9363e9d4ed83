"""Trajectories whose writers work while the next one is computed."""

import os
import threading
import weakref
from dataclasses import replace

import helped
import numpy as np
import pytest

from nsf.data import Trajectory, TrajectoryWriter
from nsf.data.schema import TRAJECTORY
from nsf.errors import ConfigError, InstabilityError
from nsf.gpu import without_collection
from nsf.pipeline.stages import cores, trajectories
from nsf.progress import Progress


def test_a_solver_is_gone_before_the_next_is_made(pipeline_at, tmp_path, monkeypatch):
    """Also while its writer still works: else memory of a GPU is freed while the next captures a graph."""
    start, append = trajectories._start, TrajectoryWriter.append
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

    monkeypatch.setattr(trajectories, "_start", started)
    monkeypatch.setattr(TrajectoryWriter, "append", late)
    with without_collection():  # which would free what holds itself
        pipeline_at(tmp_path).simulate()
    assert len(solvers) > 1
    assert left == [0] * len(solvers)
    assert not any(solver() for solver in solvers)


@pytest.mark.slow
def test_trajectories_of_several_processes_are_the_same(chain, pipeline_at, tmp_path, monkeypatch):
    """Bit for bit, and the bar ends at its total."""
    counted = []
    monkeypatch.setattr(cores, "helper_count", lambda *of: 1)
    monkeypatch.setattr(Progress, "advance", lambda self, count=1: counted.append(count))
    pipeline = pipeline_at(tmp_path)
    for run in pipeline.simulate():
        alone = chain.pipeline.root / run.id / TRAJECTORY
        with Trajectory.open(run.file(TRAJECTORY)) as ours, Trajectory.open(alone) as theirs:
            for field in ("x", "v", "C", "tau"):
                np.testing.assert_array_equal(ours.read(field), theirs.read(field))
    assert sum(counted) == len(pipeline.runs_of("simulate")) * (pipeline.scene.steps + 1)


@pytest.mark.parametrize("early", [0, 1])
def test_helping_processes_count_here(early):
    steps = []
    with cores.ahead(early, "helped") as pool, cores.helping(helped.count, 1, steps.append, pool) as helpers:
        assert cores.claimed(helpers.folder, 1)
        ((number, process, claimed),) = helpers.results()
        assert not cores.claimed(helpers.folder, 0)
    assert (number, claimed, sum(steps)) == (0, True, 3)
    assert process != os.getpid()


def test_an_error_of_another_process_is_one_here():
    with pytest.raises(InstabilityError, match="it burst"), cores.helping(helped.fail, 1, print) as helpers:
        helpers.results()


def test_an_error_ends_the_others_at_once():
    with pytest.raises(InstabilityError), cores.helping(helped.fail_first, 2, lambda steps: None) as helpers:
        helpers.results()


def test_a_bad_field_ends_runs_that_have_begun(pipeline_at, tmp_path, monkeypatch):
    monkeypatch.setattr(cores, "helper_count", lambda *of: 1)
    pipeline = pipeline_at(tmp_path, "field.depth=0", "scene.steps=20000")
    with pytest.raises(ConfigError, match=r"field: depth=0"):
        pipeline.simulate()
    assert not any(run.complete for run in pipeline.runs_of("simulate"))


def test_processes_end_where_this_one_fails():
    with pytest.raises(KeyboardInterrupt), cores.helping(helped.go_on, 1, lambda steps: None):
        raise KeyboardInterrupt


def test_processes_that_got_no_work_end():
    with cores.ahead(1, "helped") as pool:
        process = pool.submit(os.getpid).result()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_a_launcher_says_how_many_cores_there_are(monkeypatch):
    monkeypatch.setattr(cores, "cpu_count", lambda: 8)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert (cores.cores("cpu"), cores.cores("cuda:0")) == (3, 1)
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert cores.cores("cpu") == 8


def test_helpers_are_as_many_as_are_worth_it_and_fit(chain, monkeypatch):
    monkeypatch.setattr(cores, "cores", lambda device: 8)
    monkeypatch.setattr(cores, "host_memory", lambda: 2**30)
    few, many = [chain.scene] * 4, [chain.scene] * 400
    assert [cores.helper_count("cpu", runs, 2**20) for runs in (few, many)] == [0, 7]
    assert cores.helper_count("cpu", many, 2**28) == 3  # four at once
    assert cores.helper_count("cpu", many, 2**31) == 0
