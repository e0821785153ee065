"""Jobs done by workers of dask: the same bits as here, whoever is killed."""

import dataclasses
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import distributed
import pytest
from drifting import CONFIG, write_drifting

from foldgauss.jobs import (
    SchedulerLost,
    Stopped,
    find_clips,
    local_workers,
    make_jobs,
    run_here,
    run_on,
    running_cluster,
)
from foldgauss.jobs import (
    workers as pool,
)

#: A fit that lasts, since a kill is to come in its midst.
LASTING = dataclasses.replace(CONFIG, steps=100_000)


def ignored(name, info):
    return None


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips")
    for k in range(2):
        write_drifting(folder / f"clip{k}.mp4", 10, phase=k)
    (folder / "broken.mp4").write_text("no video")
    return find_clips(folder).clips


def jobs_into(folder, clips, config=CONFIG):
    (folder / "records").mkdir()
    return make_jobs(clips, folder, config, checkpoint_seconds=0.0)


@pytest.fixture(scope="module")
def done_here(clips, tmp_path_factory):
    """Models of the clips, by name, as this process makes them."""
    folder = tmp_path_factory.mktemp("here")
    outcomes = list(run_here(jobs_into(folder, clips), ignored))
    assert [outcome.failure is None for outcome in outcomes] == [False, True, True]
    return {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}


@pytest.fixture(scope="module")
def crew():
    with local_workers(1) as made:
        yield made


def workers() -> list[multiprocessing.Process]:
    return [child for child in multiprocessing.active_children() if "Dask" in child.name]


def test_workers_make_the_same_bits_and_tell_of_what_failed(crew, clips, done_here, tmp_path):
    told = []
    outcomes = list(run_on(crew, jobs_into(tmp_path, clips), lambda *each: told.append(each)))
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.safetensors")} == done_here
    (failed,) = (outcome for outcome in outcomes if outcome.failure is not None)
    assert failed.job.name == "broken.mp4"
    assert "does not open as a video" in failed.failure
    assert {name for name, info in told if info.progress == 1} == {f"clip{k}.mp4" for k in range(2)}


@pytest.mark.parametrize(("cluster", "says"), [(None, "start some"), (object(), "if __name__")])
def test_that_no_worker_comes_is_told_with_what_to_do(monkeypatch, clips, tmp_path, cluster, says):
    monkeypatch.setattr(pool, "NO_WORKERS_SECONDS", -1.0)
    monkeypatch.setattr(distributed, "Event", Mock())
    client = Mock(status="running", nthreads=dict, cluster=cluster)
    with pytest.raises(SchedulerLost, match=says):
        list(run_on(client, jobs_into(tmp_path, clips), ignored))


def test_two_commands_at_once_take_no_port_from_each_other(crew):
    assert crew.cluster.scheduler.http_server.port != 8787  # dask's own, of which it warns when it is taken


def test_a_killed_worker_is_replaced_and_goes_on_from_the_checkpoint(crew, clips, done_here, tmp_path):
    (job,) = (job for job in jobs_into(tmp_path, clips) if job.name == "clip1.mp4")
    kills, firsts = [], []

    def watch(name, progress):
        """Who tells of the first step is killed, once."""
        if not firsts or progress.step < firsts[-1]:
            firsts.append(progress.step)
        if not kills:
            kills.extend(child.pid for child in workers())
            for pid in kills:
                os.kill(pid, signal.SIGKILL)

    (outcome,) = run_on(crew, [job], watch)
    assert outcome.failure is None
    assert len(kills) == 1
    assert kills[0] not in [child.pid for child in workers()]
    assert Path(job.target).read_bytes() == done_here["clip1.mp4.safetensors"]


def test_workers_keep_what_they_do_when_asked_to_stop(crew, clips, tmp_path):
    jobs, told = jobs_into(tmp_path, clips[1:], LASTING), []
    with pytest.raises(Stopped):
        list(run_on(crew, jobs, lambda *each: told.append(each), should_stop=lambda: bool(told)))
    assert any(job.checkpoint.exists() for job in jobs)
    assert not any(os.path.exists(job.target) for job in jobs)


@pytest.mark.slow
def test_a_job_that_kills_whoever_takes_it_is_given_up(clips, tmp_path, monkeypatch):
    monkeypatch.setattr(pool, "DEATHS", 2)
    job = dataclasses.replace(jobs_into(tmp_path, clips[1:2], LASTING)[0], checkpoint_seconds=1e9)
    killed, begun = set(), time.monotonic()

    def watch(name, progress):
        assert time.monotonic() - begun < 240
        for child in workers():
            if child.pid not in killed:
                killed.add(child.pid)
                os.kill(child.pid, signal.SIGKILL)

    with local_workers(1) as own:
        (outcome,) = run_on(own, [job], watch)
    assert len(killed) >= pool.DEATHS
    assert "its workers died" in outcome.failure
    assert "fewer workers" in outcome.failure


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="reads of a process what Linux tells in /proc")
def test_a_worker_that_starts_leaves_ctrl_c_to_others():
    """A terminal sends it to all of them."""
    others = workers()
    with local_workers(1):
        until = time.monotonic() + 120
        while not (started := [child for child in workers() if child not in others]):
            assert time.monotonic() < until
            time.sleep(0.01)
        (told,) = (
            line
            for line in Path(f"/proc/{started[0].pid}/status").read_text().splitlines()
            if line.startswith("SigBlk")
        )
    assert int(told.split()[1], 16) >> (signal.SIGINT - 1) & 1


@pytest.mark.parametrize(("named", "name"), [({"count": 0}, "workers"), ({"count": 1, "threads": 0}, "threads")])
def test_counts_that_are_none_are_refused(named, name):
    with pytest.raises(ValueError, match=f"^{name}: expected a whole number"), local_workers(**named):
        pass


def test_an_address_where_nobody_answers_is_refused(monkeypatch):
    monkeypatch.setattr(pool, "CONNECT_SECONDS", 0.5)
    with pytest.raises(SchedulerLost, match="scheduler: expected the address"), running_cluster("tcp://127.0.0.1:9"):
        pass


def test_without_dask_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"foldgauss\[distributed\]"), local_workers(1):
        pass


@pytest.mark.parametrize("address", ["localhost", "http://127.0.0.1:8786", "tcp://host:port", ""])
def test_what_is_no_address_is_refused_at_once(address):
    refused = pytest.raises(ValueError, match=r"^scheduler: expected an address as tcp://host:8786")
    with refused, running_cluster(address):
        pass
