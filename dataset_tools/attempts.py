"""Attempts made by worker processes until a recording has its episodes."""

import multiprocessing
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from dataset_tools.pool import one_thread_each
from dataset_tools.record_settings import SEED_LIMIT
from dataset_tools.record_worker import WorkerSetup, make_attempt, start_worker
from dataset_tools.shards import Outcome, missing_attempts

TOLERATED_FAILURES = 20
"""A recording gives up when more attempts than this, and more than have succeeded, have failed."""


def make_attempts(setup: WorkerSetup, workers: int, outcomes: dict[int, Outcome], episodes: int) -> Iterator[Outcome]:
    """Make the attempts that are missing for ``episodes`` successes; yields each outcome when its shard is committed.

    Args:
        setup: what the worker processes must know.
        workers: number of processes.
        outcomes: finished attempts; grows.
        episodes: successes of every task to reach.

    Raises:
        ValueError: the recording would need scene seeds that belong to evaluation.
        ChildProcessError: a worker process died, or an attempt raised.
        RuntimeError: most attempts fail.
    """
    context = multiprocessing.get_context("spawn")
    pending: dict[Future[Outcome], int] = {}
    with one_thread_each(), ProcessPoolExecutor(workers, context, start_worker, (setup,)) as pool:
        try:
            while missing := missing_attempts(outcomes, episodes, len(setup.tasks)):
                _check_sense(setup.seed + max(missing), outcomes)
                ready = [attempt for attempt in missing if attempt not in pending.values()]
                for attempt in ready[: workers + 1 - len(pending)]:
                    pending[pool.submit(make_attempt, attempt)] = attempt
                for future in sorted(wait(pending, return_when=FIRST_COMPLETED).done, key=pending.__getitem__):
                    attempt = pending.pop(future)
                    outcomes[attempt] = _result(future, setup.seed + attempt)
                    yield outcomes[attempt]
        finally:
            pool.shutdown(cancel_futures=True)


def _result(future: Future[Outcome], seed: int) -> Outcome:
    kept = "finished episodes are kept and the same command goes on from there"
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise ChildProcessError(
            f"a recording process died (killed, or out of memory? fewer --workers need less); {kept}"
        ) from error
    except Exception as error:
        raise ChildProcessError(f"the attempt with scene seed {seed} broke off ({error}); {kept}") from error


def _check_sense(last_seed: int, outcomes: dict[int, Outcome]) -> None:
    if last_seed >= SEED_LIMIT:
        raise ValueError(
            f"the recording needs scene seed {last_seed}, but seeds from {SEED_LIMIT} on are for evaluation"
        )
    failures = Counter(outcome.failure for outcome in outcomes.values() if not outcome.success)
    failed = failures.total()
    if failed > max(TOLERATED_FAILURES, len(outcomes) - failed):
        kinds = ", ".join(f"{kind}: {number}" for kind, number in failures.most_common())
        raise RuntimeError(f"{failed} of {len(outcomes)} attempts failed ({kinds}); the expert does not fit the scene")
