"""`vla-attention view`: a local page on which a store is explored, the same page as files, or Rerun recordings."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from vla_attention.schemas.command_line import OneSentenceParser
from vla_attention.schemas.stores.store_format import parse_episode_name
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vla_attention.analyze.view.served_stores import ServedStore
    from vla_attention.schemas.stores.reader import Store, StoredEpisode
    from vla_attention.schemas.stores.store_url import StorePlace

_EXAMPLES = """examples:
  vla-attention view runs/cubes.zarr
  vla-attention view runs/cubes.zarr reruns/cubes/no_text.zarr         a run beside its rerun
  vla-attention view runs/cubes.zarr --file episode.html --task 3 --episode 1       one episode, to send
  vla-attention view runs/cubes.zarr --rrd episode.rrd --task 3         one episode for Rerun's viewer
  vla-attention view hf://datasets/ORG/NAME/libero_10.zarr
  vla-attention view runs/cubes.zarr --port 8765 --no-open           on another machine, with ssh -L 8765:127.0.0.1:8765
  vla-attention view runs/cubes.zarr --port 8765 --allow-host hub.example.org      behind a proxy, as JupyterHub
  vla-attention view runs/cubes.zarr --site public/cubes               a folder for a web server

The page is served to this machine only, to whoever has the printed link, until Ctrl-C. It asks nothing of any other
place. With the same stores and the same --port the link stays the same.
"""

#: Options, and with what they go: what is written, or the page that is served.
_SERVED = "a page that is served"
_OPTIONS_OF = {
    "--task": ("--file", "--rrd"),
    "--episode": ("--file", "--rrd"),
    "--heads": ("--file", "--site"),
    **dict.fromkeys(("--port", "--allow-host", "--no-open"), (_SERVED,)),
}


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention view STORE ...`."""
    from pathlib import Path

    parser = OneSentenceParser(
        prog="vla-attention view",
        description="Explore attention in the browser: episodes, pictures, words, layers and heads, groups, two runs "
        "side by side.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help="NAME.zarr or addresses")
    parser.add_argument("--port", type=int, metavar="N", help="port of the page (default: any free one)")
    parser.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="also answer under this host's name, that of a proxy (JupyterHub, Open OnDemand); may be repeated",
    )
    parser.add_argument("--no-open", action="store_true", help="print the link only")
    parser.add_argument(
        "--site", type=Path, metavar="FOLDER", help="write the page with all answers into a folder for any web server"
    )
    parser.add_argument(
        "--file", type=Path, metavar="PAGE.html", help="write one episode as a page in one file that opens from disk"
    )
    rrd = "write one episode as a Rerun recording, or every one into a folder (needs the extra [rerun])"
    parser.add_argument("--rrd", type=Path, metavar="NAME.rrd|FOLDER", help=rrd)
    task = "of --file and --rrd: the episode's task (default: the first; of a folder: all)"
    parser.add_argument("--task", type=int, metavar="N", help=task)
    number = "of --file and --rrd: its number (default: the first; of a folder: all)"
    parser.add_argument("--episode", type=int, metavar="N", help=number)
    parser.add_argument("--heads", action="store_true", help="of --site and --file: with the rows of every head")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, or write it."""
    from contextlib import ExitStack, closing

    from vla_attention.analyze.view.served_stores import ServedStore
    from vla_attention.analyze.view.static_site import check_site
    from vla_attention.analyze.view.summaries import Summary
    from vla_attention.schemas.errors import BadArgument
    from vla_attention.schemas.stores.reader import open_store

    if arguments.site is not None:
        check_site(arguments.site)
    places: list[StorePlace] = list(dict.fromkeys(arguments.stores))
    written = [name for name in ("--file", "--rrd", "--site") if getattr(arguments, name.strip("-")) is not None]
    if len(written) > 1:
        raise BadArgument(f"{' and '.join(written)} are two things to write; give one of them.")
    what = written[0] if written else _SERVED
    for option, of in _OPTIONS_OF.items():
        given = getattr(arguments, option.strip("-").replace("-", "_"))
        if what not in of and not (given is None or given is False or given == []):
            raise BadArgument(f"{option} goes with {' or '.join(of)}, and not with {what}; leave one of them out.")
    if len(places) > 1 and written not in ([], ["--site"]):
        raise BadArgument(f"{written[0]} writes episodes of one store, and {len(places)} are given; give one.")
    if arguments.rrd is not None:
        _write_recordings(arguments, open_store(places[0]))
        return 0
    with ExitStack() as stack:
        stores = [ServedStore(open_store(place), stack.enter_context(closing(Summary()))) for place in places]
        for store in stores:
            store.summary.begin(store.store)
        if arguments.site is None and arguments.file is None:
            _serve(arguments, stores)
        else:
            _write(arguments, stores)
    return 0


def _write(arguments: argparse.Namespace, stores: Sequence[ServedStore]) -> None:
    import warnings

    from vla_attention.analyze.view.static_site import site_size, write_page_file, write_site
    from vla_attention.schemas.command_line import format_bytes
    from vla_attention.schemas.errors import Note, plural

    # Before the numbers of all episodes are waited for.
    episodes = [] if arguments.file is None else _wanted(arguments, stores[0].store)
    if arguments.site is not None:
        about = format_bytes(site_size(stores, arguments.heads))
        print(f"About {about} for {sum(len(store.store.episodes) for store in stores)} episodes.", flush=True)
    for store in stores:
        if failed := store.summary.wait():
            warnings.warn(f"Not every episode of {store.store.path} has numbers: {failed}", Note, stacklevel=2)
    if not episodes:
        print(write_site(arguments.site, stores, arguments.heads))
        return
    print(write_page_file(arguments.file, stores[0], episodes[0], arguments.heads))
    if others := len(episodes) - 1:
        print(f"The store has {plural(others, 'other episode')} of those asked for; --task and --episode choose one.")


def _write_recordings(arguments: argparse.Namespace, store: Store) -> None:
    from vla_attention.analyze.view.rrd_file import SUFFIX, write_recordings

    episodes = _wanted(arguments, store)
    print(write_recordings(arguments.rrd, store, episodes[:1] if arguments.rrd.suffix == SUFFIX else episodes))


def _wanted(arguments: argparse.Namespace, store: Store) -> list[StoredEpisode]:
    """The episodes that --task and --episode name."""
    from vla_attention.schemas.errors import BadArgument, listing

    given = arguments.task, arguments.episode
    episodes = [
        one
        for one in store.episodes
        if all(number in (None, own) for number, own in zip(given, parse_episode_name(one.name), strict=True))
    ]
    if not episodes:
        names = listing([one.name for one in store.episodes], 20)
        raise BadArgument(f"{store.path} has no such episode (--task, --episode); it has {names}.")
    return episodes


def _notes(stores: Sequence[Store]) -> tuple[str, ...]:
    """What is said of the runs before the page opens, which neither damaged episodes nor a slow address may delay."""
    from contextlib import suppress
    from pathlib import Path

    from vla_attention.analyze.stores.run_notes import change_notes, episode_notes
    from vla_attention.schemas.errors import UserError

    readable = []
    for store in stores:
        for episode in store.episodes if isinstance(store.path, Path) else ():
            with suppress(UserError):
                readable.append((store, episode.attributes))
    return (*change_notes(stores), *episode_notes(readable))


def _serve(arguments: argparse.Namespace, stores: Sequence[ServedStore]) -> None:
    from vla_attention.analyze.render.browser import open_in_browser
    from vla_attention.analyze.view.server import ViewerServer

    with ViewerServer(stores, arguments.port or 0, allow_hosts=arguments.allow_host, keep_link=True) as server:
        again = f"; with --port {server.port} its link stays the same" if server.keeps_link else ""
        # At once, also into a file that somebody follows.
        for line in _notes([store.store for store in stores]):
            print(f"note: {line}")
        print(f"The page: {server.link}\nIt is served to this machine only, until Ctrl-C{again}.", flush=True)
        if arguments.allow_host:
            print(
                f"Behind a proxy: its address of port {server.port}, and then {server.token}/ (JupyterHub: "
                f"https://{arguments.allow_host[0]}/user/NAME/proxy/{server.port}/{server.token}/).",
                flush=True,
            )
        if not arguments.no_open:
            open_in_browser(server.link)
        server.serve_forever()
