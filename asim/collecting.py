"""Waiting for a collection, in however many shards, and telling what all of them brought."""

from collections import Counter
from uuid import UUID

from api_schemas.jobs import CollectionStarted
from asim.client import Client
from asim.errors import JobFailed
from asim.report import Advance


def await_collection(client: Client, started: CollectionStarted, advance: Advance) -> dict[str, object]:
    """The sum of the jobs' results, once all of them have ended. Raises JobFailed for the first that failed, or
    JobCancelled; what the others have stored stays."""
    results, failed = list[dict[str, object]](), list[JobFailed]()
    for job in started.jobs:
        try:
            results.append(_await(client, job, len(results) + len(failed), len(started.jobs), advance))
        except JobFailed as error:
            failed.append(error)
    if failed:
        raise failed[0]
    return summed(results)


def summed(results: list[dict[str, object]]) -> dict[str, object]:
    """Numbers added up, also those by name. What one shard is short of no other makes up for."""
    total: dict[str, object] = {}
    for name, value in results[0].items():
        values = [result[name] for result in results]
        if isinstance(value, dict):
            total[name] = dict(sum((Counter(each) for each in values if isinstance(each, dict)), Counter[str]()))
        else:
            total[name] = sum(int(str(each)) for each in values)
    return total


def _await(client: Client, job: UUID, ended: int, jobs: int, advance: Advance) -> dict[str, object]:
    of = "" if jobs == 1 else f"job {ended + 1} of {jobs}: "
    done = client.wait_for_job(job, progress=lambda seen: advance((ended + seen.progress) / jobs, of + seen.message))
    return done.result
