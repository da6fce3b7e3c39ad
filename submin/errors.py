"""What can go wrong, as a tree that callers can catch."""


class SubminError(Exception):
    """Base of every error that submin raises on purpose."""


class InputError(SubminError):
    """Input that cannot be used as it is: the message names the file, the place, the value, and what was expected."""


class CatalogueError(InputError):
    """A catalogue that does not keep its contract (columns, types, unknown images, frame)."""


class StoreError(SubminError):
    """A network store that cannot be opened, read or written."""


class ConflictError(StoreError):
    """Another coordinator committed to the network while this one was at work."""


class BusyError(StoreError):
    """Another process is writing to the network."""


class ClusterError(SubminError):
    """The processes that compute were lost: the scheduler, or workers."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")
        self.problem, self.remedy = problem, remedy


class KilledTaskError(ClusterError):
    """The workers that ran a task were killed, one after the other."""

    def __init__(self, task: str, workers: int) -> None:
        super().__init__(
            f"{workers} workers that ran the same task ({task}) were killed, as happens where memory is short",
            "give the same command again, with fewer workers or fewer --batch-blocks",
        )
        self.task, self.workers = task, workers


class NumericalError(SubminError):
    """A computation without a trustworthy result (a matrix that is not positive definite, no convergence)."""


class QueryError(InputError):
    """A query that cannot be answered as asked (unknown policy, tile, version or point)."""
