"""Fits as jobs: one runner for every fit, long clips in segments, many clips, and workers on this machine or a cluster.

A job (`FitJob`) holds all that its fit depends on, and its results are on disk: a process may be killed at any moment,
and the next one continues to the same bits. `plan_long_fit` and `make_jobs` make jobs, `fit_job`, `run_here` and
`run_on` run them.
"""

from foldgauss.jobs.job import FitJob, find_clips, make_jobs
from foldgauss.jobs.runner import Stopped, fit_job
from foldgauss.jobs.segments import LongFit, plan_long_fit, segments_folder
from foldgauss.jobs.workers import Outcome, SchedulerLost, local_workers, run_here, run_on, running_cluster

__all__ = [
    "FitJob",
    "LongFit",
    "Outcome",
    "SchedulerLost",
    "Stopped",
    "find_clips",
    "fit_job",
    "local_workers",
    "make_jobs",
    "plan_long_fit",
    "run_here",
    "run_on",
    "running_cluster",
    "segments_folder",
]
