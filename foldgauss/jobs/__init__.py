"""Fits that outgrow one process: long clips in segments, many clips, by workers here or on a cluster.

What is done is on disk, so any process may be killed: who comes next takes up what is there, with the same bits.
"""

from foldgauss.jobs.fitting import FitJob, Progress, Stopped, fit_job
from foldgauss.jobs.long import JoinedFit, LongFit, plan_long_fit, seam_drops, segments_folder
from foldgauss.jobs.many import find_clips, jobs_of
from foldgauss.jobs.pool import Outcome, SchedulerLost, WorkerPool, local_workers, run_here, run_on, running_cluster

__all__ = [
    "FitJob",
    "JoinedFit",
    "LongFit",
    "Outcome",
    "Progress",
    "SchedulerLost",
    "Stopped",
    "WorkerPool",
    "find_clips",
    "fit_job",
    "jobs_of",
    "local_workers",
    "plan_long_fit",
    "run_here",
    "run_on",
    "running_cluster",
    "seam_drops",
    "segments_folder",
]
