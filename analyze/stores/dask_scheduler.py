"""Episodes on the workers of a dask.distributed scheduler that runs already. It replaces workers that die."""

from __future__ import annotations

import logging
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from typing import Any

from vla_attention.schemas.errors import BadArgument, MissingDependency, UserError

#: Episodes that are begun beyond the one whose result is waited for, for each thread of the cluster.
_BEGUN_AHEAD = 2
#: So many are begun at least: a cluster that grows with its work starts workers for waiting episodes.
_BEGUN_AT_LEAST = 16
#: Seconds within which a scheduler must answer.
_ANSWER_WITHIN = 15


class SchedulerLost(UserError, ConnectionError):
    """The scheduler does not answer, or its workers died again and again with an episode."""


class DaskScheduler:
    """The engine (`parallel.Engine`) of a cluster; `address` as dask's `Client` takes it, for instance tcp://node:8786.

    A context manager: connected within the block.

    Raises:
        MissingDependency: dask.distributed is not installed.
        BadArgument: no scheduler answers at the address.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._client: Any = None
        self._numbers = count()

    def __enter__(self) -> DaskScheduler:
        try:
            from distributed import Client
            from distributed.comm.addressing import get_address_host_port
        except ImportError:
            raise MissingDependency(
                "--scheduler needs dask.distributed, which is not installed: pip install 'vla-attention[dask]', on the "
                "workers too."
            ) from None
        # What it says of lost connections stands in our own sentence.
        for name in ("distributed.client", "distributed.core", "distributed.comm", "distributed.batched"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            # A client made with what is no address waits half a minute at its end, and then prints a traceback.
            check: Any = get_address_host_port
            check(self._address)
            connect: Any = Client  # dask's own signature has no types
            self._client = connect(self._address, timeout=_ANSWER_WITHIN, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise BadArgument(
                f"No scheduler answers at '{self._address}' ({str(error) or type(error).__name__}); expected the "
                "address of a running dask scheduler, as tcp://HOST:8786: start one with `dask scheduler` "
                "(docs/cluster.md)."
            ) from None
        return self

    def __exit__(self, *_: object) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close(timeout=5)

    def results(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Results in the order of the items; raises the error of the first item that fails.

        Raises:
            SchedulerLost: the connection was lost, or several workers died with the same episode.
        """
        from vla_attention.analyze.stores.parcels import Parcel, package_version, work

        begun: deque[tuple[Parcel, Any]] = deque()
        run, own_version = uuid.uuid4().hex[:8], package_version()
        left = iter(items)
        try:
            while True:
                room = self._room()
                while len(begun) < room and (item := next(left, _NONE)) is not _NONE:
                    parcel = Parcel.of(function, item)
                    key = f"{parcel.name}-{run}-{next(self._numbers)}"
                    begun.append((parcel, self._client.submit(work, parcel.content, own_version, key=key, pure=False)))
                if not begun:
                    return
                parcel, future = begun[0]
                answer = self._answer(parcel.name, future)
                begun.popleft()
                yield parcel.result(answer)
        finally:
            if begun and self._client is not None and self._client.status == "running":
                self._client.cancel([future for _, future in begun])

    def _room(self) -> int:
        threads = sum(self._client.nthreads().values()) if self._client.status == "running" else 0
        return max(_BEGUN_AT_LEAST, threads * _BEGUN_AHEAD)

    def _answer(self, name: str, future: Any) -> bytes:
        from distributed import CancelledError
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        try:
            answer: bytes = future.result()
        except KilledWorker as error:
            raise SchedulerLost(
                f"Workers of {self._address} died {error.allowed_failures + 1} times with {name}, the last one was "
                f"{error.last_worker.address}: the system may have ended them for lack of memory; give them more, and "
                "look at their logs."
            ) from None
        except (CancelledError, CommClosedError, TimeoutError):
            raise SchedulerLost(
                f"The connection to the scheduler {self._address} was lost while {name} was measured; start it again, "
                "and then the same command."
            ) from None
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("vla_attention"):
                raise
            raise MissingDependency(
                f"The workers of {self._address} lack this package ({error}); install the same version of "
                "vla-attention in their environment."
            ) from None
        return answer


_NONE = object()
