"""The paper's tables and ablations as a list of jobs, and what they cost."""

from pipeline.reproduction.cost import Cost, cost_table, job_cost
from pipeline.reproduction.jobs import DETECTIONS, Job, Request, list_jobs

__all__ = ["DETECTIONS", "Cost", "Job", "Request", "cost_table", "job_cost", "list_jobs"]
