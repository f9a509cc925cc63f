"""Episodes one after the other; those of a store that is elsewhere are opened some episodes ahead.

Opening an episode that is elsewhere is a request, most of whose time is waiting. Hundreds of them, one after the other,
would take a minute.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from vla_attention.analyze.stores.parallel import in_order, stoppable_threads
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_url import StoreUrl

#: Requests that are under way at once.
_AHEAD = 16


def read_ahead(episodes: Iterable[StoredEpisode]) -> Iterator[StoredEpisode]:
    """The same episodes in their order; what cannot be read raises where the caller reads it."""
    with stoppable_threads(_AHEAD, "ahead") as executor:
        yield from in_order(lambda episode: _begun(executor, episode), episodes, _AHEAD)


def _begun(executor: ThreadPoolExecutor, episode: StoredEpisode) -> Future[StoredEpisode]:
    if isinstance(episode.folder, StoreUrl):
        return executor.submit(_opened, episode)
    here: Future[StoredEpisode] = Future()
    here.set_result(episode)
    return here


def _opened(episode: StoredEpisode) -> StoredEpisode:
    with suppress(UserError):
        _ = episode.attributes
    return episode
